"""How the held object's tag sits on it: its corners touch the table while the camera looks (`estimation.tag_offset`).

The object is set down flat, and on a corner tilted to either side. The table's own tags tell where the table is, so
that neither the arm nor the grasp has a say.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from drivers.errors import DeviceFault
from estimation.tag_offset import TagOffset, Touch, fit_tag_offset
from estimation.tag_pose import TagPose, estimate_planar_pose
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


def seat(rig: Rig, camera: CameraModel, look: Look) -> TagOffset:
    """X_go_tag of the held object. Raises FitError, and DeviceFault where a tag or the table is not there."""
    tags = rig.context.believed.tags
    tag = tags["go"][0]
    polygon = rig.context.resolved.grasped.polygon
    touches = []
    with rig.context.progress.steps("touches", len(TILTS)) as advance:
        for tilt in TILTS:
            corners = polygon.lowest_vertices(tilt)
            _set_down(rig, polygon.vertices[corners[0]], tilt)
            X_T_tag, covariance = _seen(camera, look(), tag, tags["table"])
            touches.append(Touch(X_T_tag, corners, covariance))
            rig.mover.ramp(rig.mover.pose + (PRESS + CLEAR) * _UP, 0.5)
            advance()
    return fit_tag_offset(polygon.vertices, touches, np.array(tag.pose))


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
    camera: CameraModel, detections: list[TagDetection], tag: TagGeometry, table: tuple[TagGeometry, ...]
) -> tuple[Array, Array]:
    """The tag's pose over the table (3,) and its covariance."""
    alone = estimate_planar_pose(camera, detections, [replace(tag, pose=(0.0, 0.0, 0.0))])
    ground = estimate_planar_pose(camera, detections, table)
    for found, what in ((alone, "the object's tag"), (ground, "a tag of the table")):
        if found is None:
            raise DeviceFault("camera", f"see {what}", "it is not in view", "Clear the view onto it")
    assert isinstance(alone, TagPose) and isinstance(ground, TagPose)
    return se2.compose(se2.inverse(ground.pose), alone.pose), alone.covariance + ground.covariance
