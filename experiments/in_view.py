"""Whether the camera will see what trials go by: the tags of table and objects, at the poses that are planned.

A trial looks at them before it begins, and measures by them at every waypoint.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np

from drivers.config import TagCameraConfig
from experiments import planned_poses
from experiments.files import Resolved
from experiments.planned_poses import Poses
from experiments.setup import Believed
from mechanics import se2
from mechanics.camera import CameraModel, TagGeometry, point_in_world
from mechanics.readings import Array
from mechanics.yaml_input import Problem
from planning.plan import Plan
from planning.skills.base import SkillTask

#: the middle of a tag that has to be in the picture, as a share of its edge: an optimised plan differs from the nominal
#: one by millimetres, and only what no trial can see is refused
_MIDDLE = 0.7
#: a camera is put so that what it has to see fills at most this share of its picture
_SHARE = 0.9
#: a place for the camera is told in steps of this [m]
_STEP = 0.01


def problems(
    resolved: Resolved, known: Believed, tasks: Mapping[str, SkillTask], plans: Mapping[str, Plan]
) -> list[Problem]:
    """What of the tags no trial would see: an object that carries none, or one that is not in the picture."""
    if resolved.experiment.rehearse:  # in free air it is the arm alone that counts
        return []
    poses = planned_poses.executed(resolved, tasks, plans)
    if not known.tags["eo"] and resolved.extrinsic is not None and any(p.eo is not None for p in poses.values()):
        wrong = f"{resolved.extrinsic.name} has no tag: the camera could not see it"
        return [resolved.experiment_document.problem(("extrinsic_object",), wrong, "an object with a `tag`")]
    found = _camera(resolved, known)
    if found is None:
        return []
    where, camera = found
    eo = resolved.extrinsic
    names = {"table": "the table", "go": resolved.grasped.name, "eo": "" if eo is None else eo.name}
    for name, here in poses.items():
        for body, number in _unseen(camera, known, here):
            when = "before a trial" if number == 0 else f"at waypoint {number - 1}"
            wrong = f"no tag of {names[body]} is in the picture {when} of plan {name}"
            expected = _better(camera, [point for p in poses.values() for point in _points(known, p)])
            return [resolved.station_document.problem(("devices", where, "position"), wrong, expected)]
    return []


def _camera(resolved: Resolved, known: Believed) -> tuple[str, CameraModel] | None:
    """The camera and its name, as calibrated, else as the station file has it; None where nobody says it there."""
    for name, device in resolved.station.devices.items():
        if isinstance(device, TagCameraConfig):
            return name, known.camera or device.model
    return None


def _unseen(camera: CameraModel, known: Believed, poses: Poses) -> Iterator[tuple[str, int]]:
    """Each body that has no tag in the picture at some pose, and the first such pose."""
    for body, at in _bodies(poses):
        tags = known.tags[body]
        middles = [replace(tag, size=_MIDDLE * tag.size) for tag in tags]
        seen = [any(_in_picture(camera, _corners(tag, pose)) for tag in middles) for pose in at]
        if tags and not all(seen):
            yield body, seen.index(False)


def _bodies(poses: Poses) -> Iterator[tuple[str, Array]]:
    yield "table", np.zeros((1, 3))
    yield "go", poses.go
    if poses.eo is not None:
        yield "eo", poses.eo


def _corners(tag: TagGeometry, X_W_body: Array) -> Array:
    """Corners (4, 3) [m] of a tag in the world."""
    return point_in_world(se2.transform(X_W_body, tag.corners), tag.height)


def _in_picture(camera: CameraModel, points: Array) -> bool:
    pixels = camera.project(points)
    with np.errstate(invalid="ignore"):  # NaN: behind the camera
        inside = (pixels >= -0.5) & (pixels <= np.array([camera.width, camera.height]) - 0.5)
    return bool(inside.all())


def _points(known: Believed, poses: Poses) -> list[Array]:
    """The corners of every tag at every pose."""
    return [_corners(tag, pose) for body, at in _bodies(poses) for tag in known.tags[body] for pose in at]


def _better(camera: CameraModel, corners: Sequence[Array]) -> str:
    """A place, facing the task plane, from which this camera has all of ``corners`` in its picture."""
    points = np.concatenate(corners)
    low, high = points.min(axis=0), points.max(axis=0)
    x, _, z = (_STEP * np.round((low + high) / 2 / _STEP)).tolist()
    # a point at (px, pz) that stands at Y = py is in the picture from a distance of py − Y of at least …
    f, half = np.array([camera.K[0, 0], camera.K[1, 1]]), _SHARE * 0.5 * np.array([camera.width, camera.height])
    away = (np.abs(points[:, [0, 2]] - [x, z]) * f / half).max(axis=1) - points[:, 1]
    y = -_STEP * float(np.ceil(away.max() / _STEP))
    place = f"position: [{x:g}, {y:g}, {z:g}], look_at: [{x:g}, 0, {z:g}]"
    return f"all that a trial looks at in the picture, as from {place}"
