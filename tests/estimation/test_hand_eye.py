"""Camera and table in the arm's frame, against the exact camera model, and on the simulated station of the lab."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.config import StationConfig
from drivers.interfaces import Arm, ArmTarget, TagCamera
from drivers.sim.tag_camera import SimTagCamera
from drivers.sim.world import World
from estimation.camera_fit import fit_camera
from estimation.errors import FitError
from estimation.hand_eye import HandEyeSigmas, HandEyeView, fit_hand_eye
from estimation.hand_eye_bundle import Bundle
from estimation.tag_pose import estimate_planar_pose
from mechanics import se2
from mechanics.camera import CameraModel, TagGeometry
from mechanics.elasticity import Elasticity
from mechanics.readings import TagDetection
from mechanics.tag_board import TagBoard

CAMERA = CameraModel.looking_at((0, -0.55, 0.07), (0, 0, 0.07), 1400, 1280, 720, (-0.1, 0.05, 5e-4, -5e-4, 0))
TABLE = [TagGeometry(i, 0.04, (x, -0.03, 0.0), 0.03) for i, x in enumerate((-0.18, -0.06, 0.06, 0.18))]
OBJECT = [TagGeometry(10, 0.036, (0.0, -0.04, 0.0), 0.01)]
#: (x, y, θ) of the sag by the sine and cosine of the ee's angle: about that of 100 g in soft fingers
SAG = np.array([[5e-4, 0.0], [0.0, -5e-4], [1.5e-2, 0.0]])
NONE = HandEyeSigmas()


def displaced(camera: CameraModel, turn: float, move: float, rng: np.random.Generator) -> CameraModel:
    X_WC = camera.X_WC.copy()
    X_WC[:3, :3] = Rotation.from_rotvec(rng.normal(0, turn, 3)).as_matrix() @ X_WC[:3, :3]
    X_WC[:3, 3] += rng.normal(0, move, 3)
    return replace(camera, X_WC=X_WC)


def seen(camera: CameraModel, tag: TagGeometry, X_W_body: np.ndarray) -> TagDetection:
    """By complex numbers: a pose is z -> e^{iθ} z + (x + iy)."""
    z = 0.5 * tag.size * np.array([-1 - 1j, 1 - 1j, 1 + 1j, -1 + 1j])
    for x, y, theta in (tag.pose, X_W_body):
        z = np.exp(1j * theta) * z + complex(x, y)
    return TagDetection(tag.id, camera.project(np.column_stack((z.real, np.full(4, -tag.height), z.imag))), 0, 100.0)


@dataclass
class Setup:
    """A camera, an arm that moves a tag, and a table, with errors of the sizes in ``sigmas`` where ``noisy``."""

    seed: int = 0
    noisy: bool = False
    n: int = 18
    turn: float = 0.5
    span: tuple[float, float] = (0.3, 0.12)
    sigmas: HandEyeSigmas = field(default_factory=lambda: HandEyeSigmas(sag=0.1))
    height_error: float = 0.0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        sigmas, level = self.sigmas, float(self.noisy)

        def one(*shape: int) -> np.ndarray:
            return level * rng.standard_normal(shape)

        self.rough = displaced(CAMERA, 0.05, 0.02, rng)
        self.camera = displaced(CAMERA, 0.02, 0.01, rng)
        self.X_ee_B, self.X_W_table = np.array([1.4e-3, -0.0445, 0.03]), np.array([3e-4, 2e-4, 3e-3])
        self.share = 1 + sigmas.sag * float(one(1)[0])
        seats = [one(4) * sigmas.seat for _ in TABLE]
        table = [
            replace(g, pose=tuple(np.add(g.pose, d[:3])), height=g.height + d[3])
            for g, d in zip(TABLE, seats, strict=True)
        ]
        carried = [replace(g, height=g.height + self.height_error) for g in OBJECT]
        self.views = []
        for _ in range(self.n):
            X_W_ee = np.array([0.0, 0.2, 0.0]) + rng.uniform(-0.5, 0.5, 3) * (*self.span, 2 * self.turn)
            sag = SAG @ (np.sin(X_W_ee[2]), np.cos(X_W_ee[2]))
            X_W_B = se2.compose(se2.compose(X_W_ee + one(3) * sigmas.arm, self.share * sag), self.X_ee_B)
            found = [seen(self.camera, g, X_W_B) for g in carried]
            found += [seen(self.camera, g, self.X_W_table) for g in table]
            found = [replace(d, corners=d.corners + sigmas.corner * one(4, 2)) for d in found]
            self.views.append(HandEyeView(X_W_ee, tuple(found), sag))


def camera_error(found: CameraModel, true: CameraModel) -> np.ndarray:
    """(turn in the camera's axes, position in W) of what was found less what is true."""
    turn = Rotation.from_matrix(true.X_WC[:3, :3].T @ found.X_WC[:3, :3]).as_rotvec()
    return np.concatenate((turn, found.X_WC[:3, 3] - true.X_WC[:3, 3]))


def test_the_derivatives_are_those_of_finite_differences() -> None:
    setup = Setup(noisy=True, n=5)
    bundle = Bundle(dict(enumerate(setup.views)), OBJECT, TABLE, setup.rough, NONE)
    rng = np.random.default_rng(1)
    z = bundle.z0 + 1e-3 * rng.standard_normal(bundle.z0.size)
    z[:3] += 0.05
    numeric = np.stack(
        [(bundle.evaluate(z + h)[0] - bundle.evaluate(z - h)[0]) / 2e-6 for h in 1e-6 * np.eye(z.size)], axis=1
    )
    jacobian = bundle.evaluate(z)[1]
    np.testing.assert_allclose(jacobian, numeric, rtol=1e-6, atol=1e-7 * np.abs(numeric).max())


def test_perfect_views_give_camera_object_and_table() -> None:
    setup = Setup()
    fit = fit_hand_eye(setup.views, OBJECT, setup.rough, table=TABLE)
    np.testing.assert_allclose(camera_error(fit.camera, setup.camera), 0, atol=1e-8)
    np.testing.assert_allclose(fit.X_ee_B, setup.X_ee_B, atol=1e-8)
    assert fit.X_W_table is not None
    np.testing.assert_allclose(fit.X_W_table, setup.X_W_table, atol=1e-8)
    np.testing.assert_allclose(fit.arm_errors, 0, atol=1e-8)
    assert fit.sag_share == pytest.approx(1)
    assert (fit.rejected, fit.n_views) == ((), 18)
    assert fit.rms_px < 1e-5


def test_the_table_is_not_needed_and_the_arm_may_have_any_frame_of_the_plane() -> None:
    setup = Setup()
    X_NW = np.array([1.3, -0.4, 1.9])  # the arm's base stands elsewhere and looks elsewhere
    views = [
        HandEyeView(se2.compose(X_NW, v.X_W_ee), tuple(d for d in v.detections if d.id == 10), v.sag)
        for v in setup.views
    ]
    fit = fit_hand_eye(views, OBJECT, setup.rough)
    assert fit.X_W_table is None and fit.X_W_table_covariance is None
    np.testing.assert_allclose(fit.X_ee_B, setup.X_ee_B, atol=1e-7)
    pose, height, tilt = _planar(fit.camera.X_WC @ np.linalg.inv(setup.camera.X_WC))
    np.testing.assert_allclose(pose[:2], X_NW[:2], atol=1e-7)
    assert np.exp(1j * pose[2]) == pytest.approx(np.exp(1j * X_NW[2]), abs=1e-7)
    assert (height, tilt) == (pytest.approx(0, abs=1e-7), pytest.approx(0, abs=1e-6))


def _planar(X: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Planar pose, shift out of the plane and tilt of a motion of space; the plane is X, Z and angles run about −Y."""
    R = X[:3, :3]
    angle = np.arctan2(R[2, 0], R[0, 0])
    return np.array([X[0, 3], X[2, 3], angle]), float(X[1, 3]), float(np.arccos(np.clip(R[1, 1], -1, 1)))


def test_the_covariances_are_those_of_repeated_calibrations() -> None:
    scores: dict[str, list[float]] = {"camera": [], "object": [], "table": [], "misfit": []}
    for seed in range(25):
        setup = Setup(seed, noisy=True)
        fit = fit_hand_eye(setup.views, OBJECT, setup.rough, table=TABLE, sigmas=setup.sigmas)
        assert fit.X_W_table is not None and fit.X_W_table_covariance is not None
        for name, error, covariance in (
            ("camera", camera_error(fit.camera, setup.camera), fit.camera_covariance),
            ("object", fit.X_ee_B - setup.X_ee_B, fit.X_ee_B_covariance),
            ("table", fit.X_W_table - setup.X_W_table, fit.X_W_table_covariance),
        ):
            scores[name].append(float(error @ np.linalg.solve(covariance, error)) / len(error))
        scores["misfit"].append(fit.chi_square)
    means = {name: float(np.mean(values)) for name, values in scores.items()}
    # the mean of 25 has a standard deviation of √(2 / 25 d): 0.12 for the camera's six, 0.16 for three
    assert 0.6 < means["camera"] < 1.5 and 0.5 < means["object"] < 1.6 and 0.5 < means["table"] < 1.6
    assert means["misfit"] == pytest.approx(1.0, abs=0.05)


def test_what_a_motion_in_the_plane_cannot_show_is_held_and_said() -> None:
    setup = Setup(height_error=0.002)  # the tag stands 2 mm further in front than told
    fit = fit_hand_eye([replace(v, detections=v.detections[:1]) for v in setup.views], OBJECT, setup.rough)
    error = fit.camera.X_WC[:3, 3] - setup.camera.X_WC[:3, 3]
    assert error == pytest.approx((0, 0.002, 0), abs=1e-6)  # away from the viewer, along the normal, and no other way
    np.testing.assert_allclose(fit.X_ee_B, setup.X_ee_B, atol=1e-7)
    assert any("normal" in text and "10 mm" in text for text in fit.held)


def test_a_view_in_which_the_arm_was_knocked_is_left_out() -> None:
    setup = Setup(3, noisy=True)
    setup.views[5] = replace(setup.views[5], X_W_ee=setup.views[5].X_W_ee + np.array([0.002, 0, 0]))
    fit = fit_hand_eye(setup.views, OBJECT, setup.rough, table=TABLE, sigmas=setup.sigmas)
    assert fit.rejected == (5,)
    assert np.isnan(fit.arm_errors[5]).all() and np.isfinite(np.delete(fit.arm_errors, 5, axis=0)).all()
    assert np.abs(fit.X_ee_B - setup.X_ee_B)[:2].max() < 2e-4


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"turn": 0.0}, r"camera X.*object on the ee x.*turned|camera X.*object on the ee x.*0\.0°"),
        ({"turn": 0.0, "span": (0.0, 0.0)}, "object on the ee x.*0 mm in x"),
        ({"span": (0.0, 0.0)}, "camera turn z|camera X|object on the ee angle"),
    ],
    ids=["never turned", "never moved", "only turned"],
)
def test_a_motion_that_leaves_something_open_is_told_by_name(changes: dict, words: str) -> None:
    setup = Setup(noisy=True, **changes)
    with pytest.raises(FitError, match=words):
        fit_hand_eye([replace(v, detections=v.detections[:1]) for v in setup.views], OBJECT, setup.rough)


def test_an_object_that_slips_between_views_is_no_calibration() -> None:
    setup = Setup()
    views = [
        replace(v, X_W_ee=se2.compose(v.X_W_ee, np.array([0.001 * k, 0, 0.02 * (k % 3)])))
        for k, v in enumerate(setup.views)
    ]
    with pytest.raises(FitError, match="slipped"):
        fit_hand_eye(views, OBJECT, setup.rough, table=TABLE)


def test_too_few_views_and_numbers_that_are_none_are_told() -> None:
    setup = Setup()
    with pytest.raises(FitError, match="3 of 3"):
        fit_hand_eye(setup.views[:3], OBJECT, setup.rough)
    blind = [replace(v, detections=v.detections[1:]) for v in setup.views[:14]]
    with pytest.raises(FitError, match=r"tag \[10\], received 3 of 17"):
        fit_hand_eye([*blind, *setup.views[:3]], OBJECT, setup.rough)
    lost = [*setup.views[:6], replace(setup.views[6], X_W_ee=np.array([0.0, np.nan, 0.0]))]
    with pytest.raises(FitError, match="NaN in view 6"):
        fit_hand_eye(lost, OBJECT, setup.rough)
    blank = replace(setup.views[2].detections[0], corners=np.full((4, 2), np.nan))
    with pytest.raises(FitError, match="NaN in view 2"):
        fit_hand_eye([*setup.views[:2], replace(setup.views[2], detections=(blank,)), *setup.views[3:]], OBJECT, CAMERA)


# -- the station of the lab --------------------------------------------------------------------------------------------

GRASP = np.array([0.0, 0.045, 0.0])
MASS, GRAVITY = 0.1, 9.81
STIFFNESS = np.diag([2000.0, 1900.0, 3.2])


@pytest.fixture(scope="module")
def lab() -> World:
    config = {
        "name": "sim",
        "world": {"profile": "lab"},
        "devices": {
            "arm": {"kind": "arm"},
            "gripper": {"kind": "gripper"},
            "camera": {"kind": "tag_camera", "position": (0, -0.55, 0.07), "look_at": (0, 0, 0.07)},
        },
        "table_tags": [{"id": g.id, "size": g.size, "pose": g.pose, "height": g.height} for g in TABLE],
    }
    box = [(-0.025, -0.07345), (0.025, -0.07345), (0.025, 0.07345), (-0.025, 0.07345)]
    tag = {"id": 10, "size": 0.036, "pose": (0.0, -0.04, 0.0), "height": 0.01}
    world = World(StationConfig.model_validate(config))
    world.reset(
        1,
        {
            "grasped": {"name": "go", "vertices": box, "mass": MASS, "tags": [tag]},
            "grasp": tuple(GRASP),
            "stiffness": STIFFNESS.tolist(),
            "friction": {"go-ground": 0.33},
            "start": (0.0, 0.2, 0.0),
        },
    )
    for device in world.devices.values():
        device.connect()
    world.regrasp(0)
    return world


def calibration_poses() -> list[np.ndarray]:
    """X_CB of the board: all over the picture, tilted both ways, near and far."""
    out = []
    for x, y, depth, *tilt in (
        *((0, 0, 0.42, a, b, 0) for a, b in ((0, 0), (30, 0), (-30, 0), (0, 30), (0, -30))),
        *((x, y, 0.55, s * 25, s * 25, 0) for x, s in ((-0.45, 1), (0.45, -1)) for y in (-0.35, 0.35)),
        *((x, y, 0.42, 30, -20, 10) for x in (-0.27, 0.27) for y in (-0.25, 0.25)),
    ):
        X_CB = np.eye(4)
        X_CB[:3, :3] = np.diag([1.0, -1, -1]) @ Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
        X_CB[:3, 3] = (x * 640 / 1400 * depth, y * 360 / 1400 * depth, depth)
        out.append(X_CB)
    return out


def sag(X_W_ee: np.ndarray) -> np.ndarray:
    """The pose of gocf in ee while the object hangs in the fingers by its weight: what the station's K foretells."""
    X_W_go = se2.compose(X_W_ee, se2.inverse(GRASP))
    for _ in range(5):
        lever = X_W_go[:2] - se2.compose(X_W_go, GRASP)[:2]
        weight = MASS * GRAVITY
        X_W_go = Elasticity(STIFFNESS).go_pose(X_W_ee, GRASP, np.array([0.0, weight, lever[0] * weight]))
    return se2.between(X_W_ee, se2.compose(X_W_go, GRASP))


def test_after_calibration_in_the_lab_tags_are_where_the_arm_has_them(lab: World) -> None:
    arm, camera = lab.devices["arm"], lab.devices["camera"]
    assert isinstance(arm, Arm) and isinstance(camera, TagCamera) and isinstance(camera, SimTagCamera)
    nominal = CameraModel.from_dict(camera.describe().extra["camera"])
    board, shots = TagBoard(), []
    for X_CB in calibration_poses():
        lab.show_board(board, nominal.X_WC @ X_CB)
        shots.append(camera.capture().detections)
    lab.show_board(None, np.eye(4))
    intrinsics = fit_camera(board.points(), shots, nominal)

    views = []
    with arm.lease("calibration"):
        for k, (x, y) in enumerate((x, y) for x in (-0.15, -0.05, 0.05, 0.15) for y in (0.15, 0.2, 0.255)):
            angle = np.radians((-30, 0, 30)[(k + k // 3) % 3])
            arm.command(ArmTarget(np.array([x, y, angle]), np.zeros(3), 0.6))
            lab.sleep(0.9)
            X_W_ee = arm.latest().pose
            views.append(HandEyeView(X_W_ee, camera.capture().detections, sag(X_W_ee)))
    fit = fit_hand_eye(views, OBJECT, intrinsics.camera, table=TABLE)

    true, bias = camera._renderer.camera, lab.lab.arm_bias
    probe = TagGeometry(1, 0.036, (0, 0, 0), 0.01)
    errors: dict[str, list[float]] = {"before": [], "after": []}
    for x in np.linspace(-0.18, 0.18, 7):
        for y in np.linspace(0.02, 0.18, 5):
            X_W_tag = np.array([x, y, 0.3])  # by the arm's own readings
            sighting = seen(true, probe, X_W_tag + np.array([*bias[:2], 0.0]))
            for name, model in (("before", nominal), ("after", fit.camera)):
                estimate = estimate_planar_pose(model, [sighting], [probe], gate=5.0)
                assert estimate is not None
                errors[name].append(float(np.linalg.norm((estimate.pose - X_W_tag)[:2])))
    before, after = (float(np.sqrt(np.mean(np.square(errors[name])))) * 1e3 for name in ("before", "after"))
    assert before > 0.2  # mm: mostly where the arm believes to be
    assert after < 0.1
    assert after < 0.35 * before
    frame = true.X_WC.copy()
    frame[(0, 2), 3] -= bias[:2]
    sigma = np.sqrt(np.diag(fit.camera_covariance))
    off = camera_error(fit.camera, replace(true, X_WC=frame))
    assert np.abs(off / sigma).max() < 3.5
    assert fit.chi_square < 2
