"""Focal lengths, principal point and lens distortion of a camera from views of a flat board of tags.

Where the board was held is not known: each view adds its six unknowns. The engine is OpenCV's bundle adjustment. Views
and single tags that disagree with it are left out, and what the views do not excite is named instead of answered.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from estimation.errors import FitError
from mechanics.camera import CameraModel
from mechanics.readings import Array, TagDetection

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
MIN_VIEWS = 4
FLOOR_PX = 0.005  # no corner is known better than that, however well the model fits
_BORDER_PX = 4.0  # a tag that is cut by the edge of the picture has corners where there was nothing to refine
_WHAT = "camera calibration"
_ROUNDS = 20
_LIMITS = np.array(
    [0.01, 0.01, 0.02, 0.02]
)  # 1 sigma of fx, fy over f and cx, cy over the width that still say something
_MISFIT = 25.0  # sigmas of a corner: no camera, but another board
_CORNER_LIMIT = 2.0  # px; 1 sigma of where the model sends the ray to a corner of the picture


@dataclass(frozen=True, slots=True)
class CameraFit:
    """A calibrated ``camera`` (its X_WC is that of the start) and what is known of it.

    ``covariance`` (9, 9) is of `PARAMETERS` [px, and none], zero for those that were ``held``. ``rms_px`` is the root
    mean square distance of the ``n_corners`` corners from where the model has them, ``view_rms_px`` (n) that of each
    view, NaN for a rejected one. ``X_CB`` (n, 4, 4) are the board's poses. ``rejected_views`` are indices of views,
    ``rejected_tags`` (view, id) in views that were kept. ``corner_sigma_px`` is the uncertainty of the model at the
    corners of the picture, 1 sigma of the worst; where no tag was seen it is an extrapolation.
    """

    camera: CameraModel
    covariance: Array
    rms_px: float
    view_rms_px: Array
    X_CB: Array
    n_views: int
    n_corners: int
    rejected_views: tuple[int, ...]
    rejected_tags: tuple[tuple[int, int], ...]
    held: tuple[str, ...]
    corner_sigma_px: float

    @property
    def sigma(self) -> dict[str, float]:
        """1 sigma by the parameter's name."""
        return dict(zip(PARAMETERS, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))


@dataclass(frozen=True, slots=True)
class _Sighting:
    view: int
    id: int
    points: Array  # (4, 3) in B
    pixels: Array  # (4, 2)


@dataclass(frozen=True, slots=True)
class _Solution:
    camera: CameraModel
    poses: dict[int, Array]  # (6,) rotation vector and position of the board in the camera, by view
    residuals: list[Array]  # (4, 2) per sighting


def fit_camera(
    points: Mapping[int, Array],
    views: Sequence[Iterable[TagDetection]],
    start: CameraModel,
    *,
    sigma: float = 0.02,
    held: Sequence[str] = ("k3",),
) -> CameraFit:
    """Calibrate from ``views`` of one board whose tags have corners ``points`` (4, 3) [m], by id, in its frame.

    ``start`` gives the picture's size and the first guess. ``sigma`` [px] is a corner coordinate's usual error: by it a
    sighting counts as an outlier, and by it what is not excited is told; the covariance comes from the residuals.
    ``held`` names distortion coefficients that stay at their start: k3 is seen only by a lens that bends much.

    Raises FitError for a board that is not flat or has no extent, for numbers that are not finite, for fewer than
    `MIN_VIEWS` usable views, for another board than described, and for views that leave focal lengths, principal point
    or lens open, with their names.
    """
    unknown = sorted(set(held) - set(PARAMETERS[4:]))
    if unknown:
        raise FitError(
            _WHAT, f"names out of {', '.join(PARAMETERS[4:])} to hold", ", ".join(unknown), "Correct `held`."
        )
    board = _checked(points)
    sightings = _collected(board, views, start)
    kept = _enough(sightings, len(views))
    solution = _solve(kept, start, held)
    for _ in range(_ROUNDS):
        good = _agreeing(kept, sightings, solution, sigma)
        if len(good) == len(kept):
            break
        kept = _enough(good, len(views))
        solution = _solve(kept, solution.camera, held)
    return _judged(kept, sightings, solution, held, sigma, len(views))


def _checked(points: Mapping[int, Array]) -> dict[int, Array]:
    board = {int(id): np.asarray(corners, float) for id, corners in points.items()}
    if not board:
        raise FitError(_WHAT, "a board with tags", "an empty one", "Describe the board that is shown.")
    for id, corners in board.items():
        if corners.shape != (4, 3) or not np.isfinite(corners).all():
            raise FitError(
                _WHAT, f"four finite corners (4, 3) of tag {id}", f"{corners.tolist()}", "Correct the board."
            )
        if np.linalg.norm(np.cross(corners[1] - corners[0], corners[3] - corners[0])) < 1e-12:
            raise FitError(_WHAT, f"a tag {id} with an area", "corners on one line", "Correct the board.")
    cloud = np.concatenate(list(board.values()))
    extent = np.linalg.svd(cloud - cloud.mean(axis=0), compute_uv=False)
    if extent[2] > 1e-6 * extent[0] or np.ptp(cloud[:, 2]) > 1e-9:
        raise FitError(_WHAT, "a flat board in the plane z = 0 of its frame", "corners out of it", "Correct the board.")
    return board


def _collected(board: dict[int, Array], views: Sequence[Iterable[TagDetection]], start: CameraModel) -> list[_Sighting]:
    """What can be used of the views: whole tags of the board, each once."""
    out: list[_Sighting] = []
    high = np.array([start.width, start.height]) - 1 - _BORDER_PX
    for k, view in enumerate(views):
        seen: dict[int, list[Array]] = {}
        for detection in view:
            if detection.id not in board:
                continue
            corners = np.asarray(detection.corners, float)
            if corners.shape != (4, 2) or not np.isfinite(corners).all():
                raise FitError(
                    _WHAT, "finite corners", f"NaN at tag {detection.id} in view {k}", "Leave that view out."
                )
            seen.setdefault(detection.id, []).append(corners)
        out += [
            _Sighting(k, id, board[id], found[0])
            for id, found in seen.items()
            if len(found) == 1 and (found[0] >= _BORDER_PX).all() and (found[0] <= high).all()
        ]
    return out


def _enough(sightings: list[_Sighting], n_views: int) -> list[_Sighting]:
    """The sightings of views that fix a pose well, with two tags or more. Raises FitError for too few views."""
    count = np.bincount([s.view for s in sightings], minlength=n_views)
    kept = [s for s in sightings if count[s.view] >= 2]
    usable = int((count >= 2).sum())
    if usable < MIN_VIEWS:
        raise FitError(
            _WHAT,
            f"{MIN_VIEWS} views or more that show two whole tags of the board",
            f"{usable} of {n_views}",
            "Show the board more often, all of it in the picture, at other tilts and places.",
        )
    return kept


def _by_view(sightings: list[_Sighting]) -> dict[int, list[_Sighting]]:
    out: dict[int, list[_Sighting]] = {}
    for sighting in sightings:
        out.setdefault(sighting.view, []).append(sighting)
    return out


def _solve(sightings: list[_Sighting], start: CameraModel, held: Sequence[str]) -> _Solution:
    views = _by_view(sightings)
    objects = [np.concatenate([s.points for s in view]).astype(np.float32) for view in views.values()]
    pixels = [np.concatenate([s.pixels for s in view]).astype(np.float32) for view in views.values()]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS
    for name, flag in (("k1", cv2.CALIB_FIX_K1), ("k2", cv2.CALIB_FIX_K2), ("k3", cv2.CALIB_FIX_K3)):
        flags |= flag if name in held else 0
    if "p1" in held or "p2" in held:
        flags |= cv2.CALIB_FIX_TANGENT_DIST
    stop = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 200, 1e-14)
    try:
        _, K, bend, turns, places = cv2.calibrateCamera(
            objects,
            pixels,
            (start.width, start.height),
            start.K.copy(),
            start.distortion.copy(),
            flags=flags,
            criteria=stop,
        )
        camera = replace(start, K=np.asarray(K, float), distortion=np.asarray(bend, float).ravel()[:5])
    except (cv2.error, ValueError) as error:
        reason = str(error).strip().splitlines()[0]
        raise FitError(
            _WHAT, "views that fix a camera", f"no solution ({reason})", "Show other tilts and places."
        ) from error
    poses = {
        k: np.concatenate((np.ravel(turn), np.ravel(place))).astype(np.float64)
        for k, turn, place in zip(views, turns, places, strict=True)
    }
    return _Solution(camera, poses, [_project(camera, poses[s.view], s.points)[0] - s.pixels for s in sightings])


def _project(camera: CameraModel, pose: Array, points: Array) -> tuple[Array, Array]:
    """Pixels (n, 2) of points (n, 3) on a board at ``pose`` (6,); derivative (2n, 15) by pose and parameters."""
    pixels, jacobian = cv2.projectPoints(points[:, None], pose[:3], pose[3:], camera.K, camera.distortion)
    return np.asarray(pixels, float).reshape(-1, 2), np.asarray(jacobian, float)


def _agreeing(kept: list[_Sighting], sightings: list[_Sighting], solution: _Solution, sigma: float) -> list[_Sighting]:
    """Without the tags that lie far off, the worst first: one pulls the others of its view with it.

    A view that has lost half of its tags (its board bent, or moved meanwhile) goes altogether.
    """
    square = np.array([np.mean(r**2) for r in solution.residuals])
    limit = max(16 * max(float(np.median(square)), sigma**2), 0.25 * float(square.max()))
    good = [s for s, e in zip(kept, square, strict=True) if e <= limit]
    left, seen = (np.bincount([s.view for s in some], minlength=len(sightings)) for some in (good, sightings))
    return [s for s in good if 2 * left[s.view] > seen[s.view]]


def _judged(
    kept: list[_Sighting],
    sightings: list[_Sighting],
    solution: _Solution,
    held: Sequence[str],
    sigma: float,
    n_views: int,
) -> CameraFit:
    """The fit with its covariance. Raises FitError for what the views leave open."""
    camera, views = solution.camera, _by_view(kept)
    frozen = tuple(name for name in PARAMETERS if name in held or (name[0] == "p" and {"p1", "p2"} & set(held)))
    free = np.array([name not in frozen for name in PARAMETERS])
    information = np.zeros((9, 9))
    for k, view in views.items():
        _, jacobian = _project(camera, solution.poses[k], np.concatenate([s.points for s in view]))
        pose, lens = jacobian[:, :6], jacobian[:, 6:15]
        beyond = lens - pose @ np.linalg.lstsq(pose, lens, rcond=None)[0]
        information += beyond.T @ beyond
    residuals = np.concatenate([r.ravel() for r in solution.residuals])
    spare = max(residuals.size - 6 * len(views) - int(free.sum()), 1)
    variance = float(residuals @ residuals) / spare
    if variance > (_MISFIT * sigma) ** 2:
        raise FitError(
            _WHAT,
            "views of the board that was described",
            f"corners {np.sqrt(variance):.2g} px off where the best camera has them",
            "Measure the board's tags and gaps, see that it is flat, and that its ids are those described.",
        )

    scale = np.where(free, 1 / np.sqrt(np.maximum(np.diag(information), 1e-30)), 0.0)
    scaled = (information * scale[:, None] * scale)[np.ix_(free, free)]
    values, vectors = np.linalg.eigh(scaled)
    inverse = np.zeros((9, 9))
    inverse[np.ix_(free, free)] = (vectors / np.maximum(values, 1e-14)) @ vectors.T
    inverse *= scale[:, None] * scale
    corner_sigma = _corner_sigma(camera, inverse)
    worst = max(variance, sigma**2) * inverse
    _need_excitation(camera, solution, kept, np.sqrt(np.diag(worst)), corner_sigma * max(variance**0.5, sigma))

    view_rms = np.full(n_views, np.nan)
    X_CB = np.full((n_views, 4, 4), np.nan)
    for k in views:
        own = [r for s, r in zip(kept, solution.residuals, strict=True) if s.view == k]
        view_rms[k] = np.sqrt(2 * np.mean(np.square(own)))
        X_CB[k] = np.eye(4)
        X_CB[k, :3, :3], X_CB[k, :3, 3] = cv2.Rodrigues(solution.poses[k][:3])[0], solution.poses[k][3:]
    covariance = max(variance, FLOOR_PX**2) * inverse
    return CameraFit(
        camera=camera,
        covariance=(covariance + covariance.T) / 2,
        rms_px=float(np.sqrt(2 * np.mean(residuals**2))),
        view_rms_px=view_rms,
        X_CB=X_CB,
        n_views=len(views),
        n_corners=4 * len(kept),
        rejected_views=tuple(k for k in range(n_views) if k not in views),
        rejected_tags=tuple(
            sorted({(s.view, s.id) for s in sightings if s.view in views} - {(s.view, s.id) for s in kept})
        ),
        held=frozen,
        corner_sigma_px=corner_sigma * max(variance**0.5, FLOOR_PX),
    )


def _corner_sigma(camera: CameraModel, inverse: Array) -> float:
    """1 sigma of where rays to the picture's corners land, for corners of tags that scatter by one pixel."""
    w, h = camera.width - 1, camera.height - 1
    straight = camera.undistort(np.array([[0.0, 0.0], [w, 0.0], [w, h], [0.0, h]]))
    rays = np.column_stack((straight, np.ones(4))) @ np.linalg.inv(camera.K).T
    lens = _project(camera, np.zeros(6), rays)[1][:, 6:15].reshape(4, 2, 9)
    spread = np.einsum("kai,ij,kaj->k", lens, inverse, lens)
    return float(np.sqrt(spread.max() if np.isfinite(spread).all() else np.inf))


def _need_excitation(
    camera: CameraModel, solution: _Solution, kept: list[_Sighting], sigma: Array, corner_sigma: float
) -> None:
    f, width = (camera.K[0, 0], camera.K[1, 1]), camera.width
    share = sigma[:4] / (*f, width, width)
    open_ = [name for name, value, limit in zip(PARAMETERS, share, _LIMITS, strict=False) if not value < limit]
    normals = np.array([cv2.Rodrigues(pose[:3])[0][:, 2] for pose in solution.poses.values()])
    about = np.degrees(
        [np.ptp(np.arcsin(np.clip(normals[:, 1], -1, 1))), np.ptp(np.arcsin(np.clip(normals[:, 0], -1, 1)))]
    )
    if open_:
        raise FitError(
            _WHAT,
            "views that fix focal lengths and principal point",
            f"{', '.join(open_)} left open: the board's tilts differ by {about[0]:.1f}° about the picture's horizontal "
            f"and {about[1]:.1f}° about its vertical over {len(solution.poses)} views",
            "Tilt the board by 20° to 40° about both axes, either way.",
        )
    if not corner_sigma < _CORNER_LIMIT:
        pixels = np.concatenate([s.pixels for s in kept])
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        raise FitError(
            _WHAT,
            "views that fix the lens up to the corners of the picture",
            f"distortion left open ({corner_sigma:.2g} px at the corners): tags were seen only from "
            f"({low[0]:.0f}, {low[1]:.0f}) to ({high[0]:.0f}, {high[1]:.0f}) px",
            "Show the board in each corner of the picture.",
        )
