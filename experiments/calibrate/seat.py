"""How the held object's tags sit on it: its corners touch the table while the camera looks (`estimation.tag_offset`).

The object is set down flat, and on a corner tilted to either side. The table's own tags tell where the table is, so
that neither the arm nor the grasp has a say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drivers.errors import DeviceFault
from estimation.tag_offset import TagOffset, Touch, fit_tag_offset
from estimation.tag_pose import estimate_planar_pose
from experiments.calibrate.rig import Rig
from mechanics import se2
from mechanics.camera import CameraModel, TagGeometry
from mechanics.readings import Array, TagDetection
from planning.skills.stance import standing_pose

#: tilts of the object that is set down [rad]: flat, and on a corner to either side
TILTS = (0.0, np.radians(26.0), np.radians(-26.0))
#: how far beyond touch the fingers go [m]: far enough for a flat face to lie down
PRESS = 0.0025
#: clearance before and after [m], and the force that shows a touch [N]
CLEAR, TOUCHED = 0.01, 0.5
_UP = np.array([0.0, 1.0, 0.0])

Look = Callable[[], list[TagDetection]]


def seats(rig: Rig, camera: CameraModel, look: Look) -> dict[int, TagOffset]:
    """X_go_tag of each tag of the held object that was in view at every touch, by its id.

    Raises FitError, and DeviceFault where no tag, or the table, is there.
    """
    tags = rig.context.believed.tags
    polygon = rig.context.resolved.grasped.polygon
    touches: dict[int, list[Touch]] = {tag.id: [] for tag in tags["go"]}
    with rig.context.progress.steps("touches", len(TILTS)) as advance:
        for tilt in TILTS:
            corners = polygon.lowest_vertices(tilt)
            _set_down(rig, polygon.vertices[corners[0]], tilt)
            for number, (X_T_tag, covariance) in _seen(camera, look(), tags["go"], tags["table"]).items():
                touches[number].append(Touch(X_T_tag, corners, covariance))
            rig.mover.ramp(rig.mover.pose + (PRESS + CLEAR) * _UP, 0.5)
            advance()
    found = {}
    for tag in tags["go"]:
        if len(touches[tag.id]) < len(TILTS):
            rig.context.event(
                "warning", f"tag {tag.id} was not in view at every touch: it counts as it was to be stuck on"
            )
        else:
            found[tag.id] = fit_tag_offset(polygon.vertices, touches[tag.id], np.array(tag.pose))
    if not found:
        raise DeviceFault(
            "camera", "see the object's tags", "none is in view at every touch", "Clear the view onto one"
        )
    return found


def _set_down(rig: Rig, corner: Array, tilt: float) -> None:
    """Lower the object at ``tilt`` onto its ``corner`` (2,), and see that it touches."""
    resolved = rig.context.resolved
    X_W_go = standing_pose(corner, np.array([tilt]), 0.0)[0]
    standing = se2.compose(X_W_go, resolved.grasp)
    table = rig.devices.force_torque("table")
    rig.lift_to(standing[1] + 2 * CLEAR)
    rig.mover.travel(np.array([standing[0], rig.mover.pose[1], standing[2]]))
    rig.mover.travel(standing + CLEAR * _UP)
    rig.rest(0.3)
    zero, _ = rig.table_samples(0.2)
    rig.mover.ramp(standing - PRESS * _UP, 1.5)
    rig.rest(0.5)
    pressed, _ = rig.table_samples(0.2)
    force = float(np.linalg.norm((pressed - zero)[:3]))
    if force < TOUCHED:
        raise DeviceFault(
            table.name,
            "set the object down",
            f"{force:.2f} N under the table, {PRESS * 1e3:g} mm beyond touch",
            "Check where the table is in the arm's frame, and the object",
        )


def _seen(
    camera: CameraModel, detections: list[TagDetection], tags: tuple[TagGeometry, ...], table: tuple[TagGeometry, ...]
) -> dict[int, tuple[Array, Array]]:
    """The pose over the table (3,) of each tag that is in view, with its covariance, by its id."""
    alone = {tag.id: estimate_planar_pose(camera, detections, [replace(tag, pose=(0.0, 0.0, 0.0))]) for tag in tags}
    seen = {number: found for number, found in alone.items() if found is not None}
    ground = estimate_planar_pose(camera, detections, table)
    for there, what in ((seen, "a tag of the object"), (ground, "a tag of the table")):
        if not there:
            raise DeviceFault("camera", f"see {what}", "it is not in view", "Clear the view onto it")
    assert ground is not None
    back = se2.inverse(ground.pose)
    return {n: (se2.compose(back, found.pose), found.covariance + ground.covariance) for n, found in seen.items()}
