"""The bundle adjustment of `estimation.hand_eye`: its unknowns, whitened residuals and their derivatives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from estimation.errors import FitError
from estimation.tag_pose import estimate_planar_pose
from mechanics.camera import CameraModel, TagGeometry, point_in_world
from mechanics.readings import Array, TagDetection
from mechanics.task_plane import TaskPlane

MIN_VIEWS = 4
WHAT = "hand-eye calibration"
#: where in the unknowns z: the camera's turn and position, the object on the ee, the table in W, the share of the sag
CAMERA, OBJECT, TABLE, SHARE = slice(0, 6), slice(6, 9), slice(9, 12), 12
_TURNED = np.array([[0.0, 1.0], [-1.0, 0.0]])  # p @ _TURNED is p turned by +90°
_IN_PLANE = point_in_world(np.eye(2)).T  # (3, 2) of a world point by a plane point
_STILL = 0.3  # px; a corner of the table that moved by more was misread
_TOWARD_VIEWER = point_in_world(np.zeros(2), 1.0)


@dataclass(frozen=True, eq=False)
class HandEyeView:
    """What the camera saw while the arm rested with its ee at ``X_W_ee`` (3,), as reported.

    ``sag`` (3,) is where the held object is predicted to hang under its weight, as the pose of gocf in ee.
    """

    X_W_ee: Array
    detections: tuple[TagDetection, ...]
    sag: Array = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True)
class HandEyeSigmas:
    """What is known beforehand, 1 sigma: ``corner`` [px]; the rest about poses in metres and radians.

    ``arm`` is the arm's error in a view (x, y, θ), ``seat`` how exactly a table tag sits (x, y, θ, height), ``sag`` the
    relative error of the predicted sag.
    """

    corner: float = 0.02
    arm: tuple[float, float, float] = (5e-5, 5e-5, 5e-4)
    seat: tuple[float, float, float, float] = (1e-4, 1e-4, 1.5e-3, 3e-4)
    sag: float = 0.25


class Bundle:
    """The residuals of a set of views, whitened, and their derivative.

    The unknowns z: camera (6), object (3), table (3), share of the sag (1), then an error of the arm (3) per view and
    a seat (4) per table tag.
    """

    def __init__(
        self,
        views: dict[int, HandEyeView],
        carried: Sequence[TagGeometry],
        table: Sequence[TagGeometry],
        start: CameraModel,
        sigmas: HandEyeSigmas,
    ):
        self.views, self.carried, self.table, self.sigmas = views, tuple(carried), tuple(table), sigmas
        on_object = [
            (i, np.asarray(d.corners, float), geometry)
            for i, view in enumerate(views.values())
            for d in view.detections
            for geometry in carried
            if d.id == geometry.id
        ]
        on_table = [(k, *stood, g) for k, g in enumerate(table) if (stood := _standing(views, g.id))[1]]
        self.pixels = np.concatenate([row[1] for row in (*on_object, *on_table)])
        self.corners = np.concatenate([row[-1].corners for row in (*on_object, *on_table)])
        self.heights = np.repeat([row[-1].height for row in (*on_object, *on_table)], 4)
        none_on_object, none_on_table = [-1] * len(on_object), [-1] * len(on_table)
        self.at_view = np.repeat([*(row[0] for row in on_object), *none_on_table], 4)
        self.at_tag = np.repeat([*none_on_object, *(row[0] for row in on_table)], 4)
        counts = [*(1 for _ in on_object), *(row[2] for row in on_table)]
        self.corner_sigma = sigmas.corner / np.sqrt(np.repeat(counts, 8))
        self.X_W_ee = np.array([view.X_W_ee for view in views.values()], float)
        self.sags = np.array([view.sag for view in views.values()], float)
        self.n_arm, self.n_seat = 3 * len(views), 4 * len(table)
        self.centres = np.array([g.pose[:2] for g in table]).reshape(-1, 2)
        self.free = np.ones(SHARE + 1 + self.n_arm + self.n_seat, bool)
        self.free[TABLE] = bool((self.at_tag >= 0).any())
        self.free[SHARE] = self.sags.any()
        self._newest: tuple[Array, tuple[Array, Array]] | None = None
        self.camera, self.z0 = self._begin(start)

    def without(self, view: int) -> Bundle:
        """The same without one view."""
        left = {k: v for k, v in self.views.items() if k != view}
        return Bundle(left, self.carried, self.table, self.camera, self.sigmas)

    def _begin(self, start: CameraModel) -> tuple[CameraModel, Array]:
        """The rough camera brought into the arm's frame, by linear least squares over planar poses.

        X_W_ee ∘ X_ee_B = X_WN ∘ X_NB for every view, N being the frame of the rough camera.
        """
        seen = [(k, estimate_planar_pose(start, v.detections, self.carried, gate=50.0)) for k, v in self.views.items()]
        pairs = [(self.views[k].X_W_ee, np.asarray(pose.pose)) for k, pose in seen if pose is not None]
        if len(pairs) < MIN_VIEWS:
            raise FitError(
                WHAT,
                "a rough pose of the camera, to a few degrees and centimetres",
                f"one by which only {len(pairs)} of {len(self.views)} sightings are tags of their size",
                "Correct the camera's position in the station file, and the size of the tag.",
            )
        rows, values = [], []
        for (x, y, theta), (u, v, _) in pairs:
            c, s = np.cos(theta), np.sin(theta)
            rows += [[c, -s, -u, v, -1, 0], [s, c, -v, -u, 0, -1]]
            values += [-x, -y]
        a, b, c, s, p, q = np.linalg.lstsq(np.array(rows), np.array(values), rcond=None)[0]
        X_WN = np.array([p, q, np.arctan2(s, c)])
        turn = np.angle(np.mean([np.exp(1j * (X_WN[2] + N[2] - W[2])) for W, N in pairs]))
        z = np.zeros(self.free.size)
        z[OBJECT], z[SHARE] = (a, b, turn), 1.0
        if self.free[TABLE].all():
            z[TABLE] = X_WN  # the rough frame is the table's
        X_WC = np.asarray(TaskPlane().pose_to_se3(X_WN), np.float64) @ start.X_WC
        X_WC[:3, :3] = Rotation.from_matrix(X_WC[:3, :3]).as_matrix()
        return replace(start, X_WC=X_WC), z

    def camera_at(self, z: Array) -> CameraModel:
        """The camera turned and moved by z."""
        X_WC = self.camera.X_WC.copy()
        X_WC[:3, :3] = X_WC[:3, :3] @ Rotation.from_rotvec(z[:3]).as_matrix()
        X_WC[:3, 3] += z[3:6]
        return replace(self.camera, X_WC=X_WC)

    def points(self, z: Array) -> tuple[Array, Array]:
        """World points (m, 3) of all corners and their derivative (m, 3, z.size), but by the camera."""
        m = len(self.corners)
        points, by_z = np.zeros((m, 3)), np.zeros((m, 3, z.size))
        on = np.flatnonzero(self.at_view >= 0)
        if on.size:
            k = self.at_view[on]
            arm = SHARE + 1 + 3 * k[:, None] + np.arange(3)
            X_W_ee = self.X_W_ee[k] + z[arm]
            chain = (X_W_ee, z[SHARE] * self.sags[k], np.broadcast_to(z[OBJECT], (on.size, 3)))
            p, (by_arm, by_sag, by_object) = _along(chain, self.corners[on])
            points[on] = point_in_world(p, self.heights[on])
            by_z[on, :, OBJECT] = _IN_PLANE @ by_object
            by_z[on, :, SHARE] = (by_sag @ self.sags[k][..., None])[..., 0] @ _IN_PLANE.T
            by_z[on[:, None], :, arm] = np.swapaxes(_IN_PLANE @ by_arm, 1, 2)
        on = np.flatnonzero(self.at_tag >= 0)
        if on.size:
            k = self.at_tag[on]
            seat = SHARE + 1 + self.n_arm + 4 * k[:, None] + np.arange(4)
            centre = np.column_stack((self.centres[k], np.zeros(on.size)))
            moved = centre + z[seat[:, :3]]
            p, (by_table, by_seat) = _along(
                (np.broadcast_to(z[TABLE], (on.size, 3)), moved), self.corners[on] - self.centres[k]
            )
            points[on] = point_in_world(p, self.heights[on] + z[seat[:, 3]])
            by_z[on, :, TABLE] = _IN_PLANE @ by_table
            by_z[on[:, None], :, seat[:, :3]] = np.swapaxes(_IN_PLANE @ by_seat, 1, 2)
            by_z[on, :, seat[:, 3]] = _TOWARD_VIEWER
        return points, by_z

    def evaluate(self, z: Array) -> tuple[Array, Array]:
        """Whitened residuals, of pixels and then of what is known beforehand, and their derivative by z."""
        if self._newest is None or not np.array_equal(self._newest[0], z):
            self._newest = (z.copy(), self._evaluated(z))
        return self._newest[1]

    def _evaluated(self, z: Array) -> tuple[Array, Array]:
        camera = self.camera_at(z)
        p_W, by_z = self.points(z)
        pixels, by_point = camera.project_with_jacobian(p_W)
        if not np.isfinite(pixels).all():  # behind the camera: worse than anything in front
            return np.full(2 * len(pixels) + z.size - SHARE, 1e6), np.zeros((2 * len(pixels) + z.size - SHARE, z.size))
        R = camera.X_WC[:3, :3]
        p_C = (p_W - camera.X_WC[:3, 3]) @ R
        by_z[:, :, :3] = R @ _cross(p_C) @ _right_jacobian(z[:3])
        by_z[:, :, 3:6] = -np.eye(3)
        jacobian = (by_point @ by_z).reshape(-1, z.size) / self.corner_sigma[:, None]
        residual = (pixels - self.pixels).ravel() / self.corner_sigma
        known = np.concatenate(
            [[self.sigmas.sag], np.tile(self.sigmas.arm, len(self.views)), np.tile(self.sigmas.seat, len(self.table))]
        )
        expected = np.zeros(known.size)
        expected[0] = 1.0
        prior = np.zeros((known.size, z.size))
        prior[:, SHARE:] = np.diag(1 / known)
        return np.concatenate((residual, (z[SHARE:] - expected) / known)), np.concatenate((jacobian, prior))

    def solve(self) -> Array:
        """Levenberg–Marquardt over the unknowns that are free."""
        z = self.z0.copy()
        free = self.free

        def full(x: Array) -> Array:
            out = z.copy()
            out[free] = x
            return out

        found = least_squares(
            lambda x: self.evaluate(full(x))[0],
            z[free],
            jac=lambda x: self.evaluate(full(x))[1][:, free],  # pyright: ignore[reportArgumentType]
            x_scale="jac",
            method="trf",
            xtol=1e-10,
            ftol=1e-10,
            gtol=1e-10,
            max_nfev=100,
        )
        return full(found.x)

    def _view_costs(self, z: Array) -> Array:
        residual = self.evaluate(z)[0]
        n = self.pixels.size
        square = (residual[:n] ** 2).reshape(-1, 2).sum(axis=1)
        on = self.at_view >= 0
        cost = np.bincount(self.at_view[on], square[on], len(self.views)) / np.bincount(self.at_view[on]) * 4
        return cost + (residual[n + 1 : n + 1 + self.n_arm] ** 2).reshape(-1, 3).sum(axis=1)

    def outlier(self, z: Array) -> int | None:
        """The view that disagrees most, where it does so by more than chance: its mean cost is 8."""
        cost = self._view_costs(z)
        worst = int(np.argmax(cost))
        return list(self.views)[worst] if cost[worst] > 10 * max(float(np.median(cost)), 4.0) else None


def _standing(views: dict[int, HandEyeView], id: int) -> tuple[Array, int]:
    """Mean corners (4, 2) of a tag that stands still, over the views that agree on them, and how many do."""
    seen = np.array([d.corners for view in views.values() for d in view.detections if d.id == id], float)
    if not len(seen):
        return np.zeros((4, 2)), 0
    good = np.abs(seen - np.median(seen, axis=0)).max(axis=(1, 2)) < _STILL
    return (np.asarray(seen[good].mean(axis=0), np.float64), int(good.sum())) if good.any() else (np.zeros((4, 2)), 0)


def _along(chain: Sequence[Array], corners: Array) -> tuple[Array, list[Array]]:
    """``corners`` (m, 2) of the last frame of a chain of poses (m, 3) in the first; derivatives (m, 2, 3) by each."""
    levers, p = [], corners
    for X in reversed(chain):
        c, s = np.cos(X[:, 2]), np.sin(X[:, 2])
        arm = np.stack((c * p[:, 0] - s * p[:, 1], s * p[:, 0] + c * p[:, 1]), axis=-1)
        levers.append(arm @ _TURNED)
        p = arm + X[:, :2]
    out = []
    turn = np.zeros(len(corners))
    for X, lever in zip(chain, reversed(levers), strict=True):
        c, s = np.cos(turn), np.sin(turn)
        R = np.stack((np.stack((c, -s), axis=-1), np.stack((s, c), axis=-1)), axis=-2)
        by = np.zeros((len(corners), 2, 3))
        by[:, :, :2] = R
        by[:, :, 2] = (R @ lever[..., None])[..., 0]
        out.append(by)
        turn = turn + X[:, 2]
    return p, out


def _cross(v: Array) -> Array:
    """[v]× (m, 3, 3) of vectors (m, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - np.swapaxes(out, 1, 2)


def _right_jacobian(turn: Array) -> Array:
    """J with exp(turn + δ) ≈ exp(turn) exp(J δ), (3, 3)."""
    angle = float(np.linalg.norm(turn))
    K = _cross(turn[None])[0]
    if angle < 1e-6:
        return np.eye(3) - K / 2
    return np.eye(3) - (1 - np.cos(angle)) / angle**2 * K + (angle - np.sin(angle)) / angle**3 * K @ K
