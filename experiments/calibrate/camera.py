"""Stage `calibrate_camera`: the lens from a tag board, the camera's place from the tag of the object in the arm's hand.

First a board is shown to the camera at many poses (`camera_fit`). Then the arm carries the held object's tag through
poses of the task plane (`hand_eye`): that gives the camera's pose in the arm's frame. Last the object's corners touch
the table (`tag_offset`), which says how the tag sits on the object.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from drivers.errors import DeviceFault
from estimation.camera_fit import CameraFit, fit_camera
from estimation.hand_eye import HandEyeFit, HandEyeView, fit_hand_eye
from experiments.calibrate import store
from experiments.calibrate.models import CameraCalibration, TagCalibration, vector3
from experiments.calibrate.rig import Rig, at_hand
from experiments.calibrate.schema import CameraStage
from experiments.calibrate.seat import seats
from experiments.calibrate.threads import one_thread
from experiments.context import RunContext
from mechanics import se2
from mechanics.camera import CameraModel
from mechanics.readings import Array, Status, TagDetection
from mechanics.tag_board import TagBoard

BOARD = TagBoard()
#: largest tilt of the board [rad], and its distances from the camera over that of the task plane
TILT, NEAR, FAR = np.radians(35.0), 0.75, 1.1
#: largest turn of the object before the camera [rad], and how much of the picture its poses fill
TURN, FILLED = np.radians(25.0), 0.5
#: longest wait for a picture [s]: a board full of tags takes its time
PATIENCE = 10.0
#: pictures of each touch
SEAT_FRAMES = 4


def camera_stage(context: RunContext, stage: CameraStage) -> None:
    """Calibrate the camera and keep it. Raises FitError where the pictures do not tell."""
    resolved = context.resolved
    rng = np.random.default_rng([resolved.experiment.seed, 2])
    with at_hand(context, "the tag camera") as rig:
        camera = rig.devices.camera
        start = CameraModel.from_dict(camera.describe().extra["camera"])
        lens = _lens(rig, stage, start, rng)
        place = _place(rig, stage, lens.camera, rng)
        offsets = seats(rig, place.camera, lambda: _averaged(rig, SEAT_FRAMES))
        rig.home()
    for number, offset in offsets.items():
        context.calibrated(
            TagCalibration(
                origin=store.origin(resolved, (camera.name,), ("go",), context.folder.path.name),
                id=number,
                pose=vector3(offset.pose),
                deviation=vector3(np.sqrt(np.diag(offset.covariance))),
            )
        )
    context.calibrated(
        CameraCalibration(
            origin=store.origin(resolved, (camera.name, rig.devices.arm.name), (), context.folder.path.name),
            device=camera.name,
            camera=place.camera.as_dict(),
            focal_deviation=lens.sigma["fx"],
            residual_px=lens.rms_px,
            views=lens.n_views,
        )
    )


def board_poses(camera: CameraModel, distance: float, count: int, rng: np.random.Generator) -> list[Array]:
    """X_WC ∘ poses (4, 4) of the board before the camera: tilted about both axes, all over the picture.

    ``distance`` [m] is that of the task plane. The printed side looks at the camera.
    """
    poses = []
    halton = np.array([[_halton(i + 1, base) for base in (2, 3, 5, 7, 11)] for i in range(count)]) * 2 - 1
    for u, v, pitch, yaw, depth in halton:
        z = distance * (NEAR + (FAR - NEAR) * (depth + 1) / 2)
        half = np.array([camera.width / camera.K[0, 0], camera.height / camera.K[1, 1]]) / 2 * z
        room = np.maximum(half - 0.75 * np.array(BOARD.half_size), 0.0)
        X_CB = np.eye(4)
        X_CB[:3, :3] = _turned(pitch * TILT, yaw * TILT, rng.uniform(-0.3, 0.3)) @ np.diag([1.0, -1.0, -1.0])
        X_CB[:3, 3] = *(np.array([u, v]) * room), z
        poses.append(camera.X_WC @ X_CB)
    return poses


def _halton(index: int, base: int) -> float:
    """The radical inverse: numbers in (0, 1) that fill it evenly in every order."""
    value, share = 0.0, 1.0 / base
    while index:
        index, digit = divmod(index, base)
        value += digit * share
        share /= base
    return value


def _turned(pitch: float, yaw: float, roll: float) -> Array:
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("xyz", [pitch, yaw, roll]).as_matrix()


def _lens(rig: Rig, stage: CameraStage, start: CameraModel, rng: np.random.Generator) -> CameraFit:
    views: list[Sequence[TagDetection]] = []
    context = rig.context
    distance = float(np.linalg.norm(start.X_WC[:3, 3] - _middle(start)))
    with context.progress.steps("poses of the board", stage.views) as advance:
        for number, pose in enumerate(board_poses(start, distance, stage.views, rng), 1):
            rig.show_board(BOARD, pose, f"Hold the tag board before the camera, pose {number} of {stage.views}, tilted")
            views.append(_averaged(rig, stage.frames))
            context.heed()
            advance()
    rig.put_board_away()
    with context.progress.step("fit the lens"), one_thread():
        return fit_camera(BOARD.points(), views, start)


def _middle(camera: CameraModel) -> Array:
    """Where the camera's axis meets the task plane, Y = 0 (3,)."""
    origin, axis = camera.X_WC[:3, 3], camera.X_WC[:3, 2]
    return origin - axis * (origin[1] / axis[1])


def _place(rig: Rig, stage: CameraStage, camera: CameraModel, rng: np.random.Generator) -> HandEyeFit:
    """Carry the object's tag through the picture."""
    tags, known = rig.context.believed.tags, rig.context.resolved
    middle = _middle(camera)
    height = max(rig.start[1] + known.grasped.polygon.bounding_radius, float(middle[2]))
    reach = FILLED * abs(float(camera.X_WC[1, 3])) * np.array([camera.width, camera.height]) / camera.K[0, 0] / 2
    views = []
    rig.lift_to(height)
    with rig.context.progress.steps("poses of the arm", stage.poses) as advance:
        for i in range(stage.poses):
            u, v, turn = (2 * _halton(i + 1, base) - 1 for base in (2, 3, 5))
            pose = np.array([middle[0] + u * reach[0], height + max(v, -0.2) * reach[1] * 0.5, turn * TURN])
            rig.mover.travel(pose)
            rig.rest(0.5)
            ee = rig.observer.arm_pose()
            sag = se2.between(ee, se2.compose(rig.hanging(ee), known.grasp))
            views.append(HandEyeView(ee, tuple(_averaged(rig, stage.frames)), sag))
            advance()
    with rig.context.progress.step("fit the camera's place"), one_thread():
        return fit_hand_eye(views, tags["go"], camera, table=tags["table"])


def _averaged(rig: Rig, frames: int) -> list[TagDetection]:
    """The tags that were seen in ``frames`` pictures, each corner the mean of its sightings."""
    camera = rig.devices.camera
    seen: dict[int, list[TagDetection]] = {}
    last: Status = Status.OK
    for _ in range(frames):
        reading = camera.capture(timeout=PATIENCE)
        last = reading.stamp.status
        if last is Status.OK:
            for detection in reading.detections:
                seen.setdefault(detection.id, []).append(detection)
    if not seen and last is not Status.OK:
        raise DeviceFault(camera.name, "see the tags", f"its pictures are {last.name.lower()}", "See to the camera")
    return [
        TagDetection(id_, np.mean([d.corners for d in found], axis=0), found[0].hamming, found[0].margin)
        for id_, found in seen.items()
    ]
