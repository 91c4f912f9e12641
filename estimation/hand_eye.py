"""Where a camera stands in the arm's frame, from tags that the arm moves through known poses of the task plane.

Planar hand-eye calibration as bundle adjustment over pixels. With the ee at X_W_ee, as the arm reports it, a corner of
the carried object's tag lies at

    X_W_ee(k) + ε(k)  ∘  s · sag(k)  ∘  X_ee_B  ∘  corner,      the tag's height in front of the task plane,

and is seen through X_WC. Unknown are X_WC, X_ee_B (how the object B lies in the unloaded fingers) and X_WT (the table,
by its tags); and, held by what is known of them beforehand, the arm's errors ε(k), the share s of the predicted sag of
the object under its weight, and how exactly each table tag sits. W's plane Y = 0 is then the arm's task plane.

Motion in a plane says nothing of the plane's distance along its normal: that is held by the carried tag's height, and
the tag is taken to be parallel to the plane. Lens and focal lengths are taken as they are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.errors import FitError
from estimation.hand_eye_bundle import CAMERA, MIN_VIEWS, OBJECT, SHARE, TABLE, WHAT, Bundle, HandEyeSigmas, HandEyeView
from mechanics.camera import CameraModel, TagGeometry
from mechanics.readings import Array

__all__ = ["MIN_VIEWS", "HandEyeFit", "HandEyeSigmas", "HandEyeView", "fit_hand_eye"]

_MAIN = (
    *("camera turn x", "camera turn y", "camera turn z", "camera X", "camera Y", "camera Z"),
    *("object on the ee x", "object on the ee y", "object on the ee angle"),
    *("table x", "table y", "table angle"),
)
_POSITION_LIMIT, _ANGLE_LIMIT = 0.005, np.radians(1.0)  # 1 sigma beyond which a number says nothing
_MISFIT = 50.0  # of the sum of squares over its degrees of freedom; a misfit of seven sigmas is no misjudged sigma
_ANGLES = (0, 1, 2, 8, 11)


@dataclass(frozen=True, slots=True)
class HandEyeFit:
    """``camera`` with X_WC in the arm's frame, ``X_ee_B`` (3,) and ``X_W_table`` (3,) or None.

    ``camera_covariance`` (6, 6) is of (rotation vector in the camera's axes, position in W); the others (3, 3).
    ``arm_errors`` (n, 3) is the part of each view that is laid to the arm, NaN for a rejected one. ``chi_square`` is
    the misfit over its degrees of freedom: 1 where the sigmas are right, and covariances are widened by it where it
    is more. ``held`` says what was not observed and is taken as told.
    """

    camera: CameraModel
    camera_covariance: Array
    X_ee_B: Array
    X_ee_B_covariance: Array
    X_W_table: Array | None
    X_W_table_covariance: Array | None
    sag_share: float
    arm_errors: Array
    rms_px: float
    chi_square: float
    n_views: int
    rejected: tuple[int, ...]
    held: tuple[str, ...]


def fit_hand_eye(
    views: Sequence[HandEyeView],
    carried: Sequence[TagGeometry],
    start: CameraModel,
    *,
    table: Sequence[TagGeometry] = (),
    sigmas: HandEyeSigmas | None = None,
) -> HandEyeFit:
    """Calibrate from ``views`` of the tags ``carried`` by the object B (poses in B) and those of the ``table``.

    ``start`` is the calibrated camera with a rough X_WC: a few degrees and centimetres out of the plane, anything
    within it. Views in which no carried tag is seen are left out, and so is one that disagrees with the others.

    Raises FitError for fewer than `MIN_VIEWS` views, numbers that are not finite, and motions that leave something
    open (an arm that never turned, say), by name.
    """
    bundle = Bundle(_usable(views, {g.id for g in carried}), carried, table, start, sigmas or HandEyeSigmas())
    z = bundle.solve()
    for _ in range(max(len(bundle.views) // 5, 1)):
        worst = bundle.outlier(z)
        if worst is None or len(bundle.views) <= MIN_VIEWS:
            break
        bundle = bundle.without(worst)
        z = bundle.solve()
    return _judged(bundle, z, len(views))


def _usable(views: Sequence[HandEyeView], carried: set[int]) -> dict[int, HandEyeView]:
    for k, view in enumerate(views):
        if not (np.isfinite(view.X_W_ee).all() and np.isfinite(view.sag).all()):
            raise FitError(WHAT, "finite poses of the arm", f"NaN in view {k}", "Leave that view out.")
        if not all(np.isfinite(d.corners).all() for d in view.detections):
            raise FitError(WHAT, "finite corners", f"NaN in view {k}", "Leave that view out.")
    usable = {k: view for k, view in enumerate(views) if any(d.id in carried for d in view.detections)}
    if len(usable) < MIN_VIEWS:
        raise FitError(
            WHAT,
            f"{MIN_VIEWS} views or more that show tag {sorted(carried)}",
            f"{len(usable)} of {len(views)}",
            "Move the arm to where the camera sees the object's tag.",
        )
    return usable


def _judged(bundle: Bundle, z: Array, n_views: int) -> HandEyeFit:
    """The fit with its covariances. Raises FitError for what the motion leaves open."""
    residual, jacobian = bundle.evaluate(z)
    free = bundle.free
    scale = 1 / np.linalg.norm(jacobian[:, free], axis=0).clip(1e-12)
    _, values, vectors = np.linalg.svd(jacobian[:, free] * scale, full_matrices=False)
    spare = bundle.pixels.size - int(free[:SHARE].sum())  # each known nuisance brings a residual of its own
    chi_square = float(residual @ residual) / max(spare, 1)
    root = vectors / np.maximum(values, 1e-9)[:, None] * scale
    covariance = np.zeros((z.size, z.size))
    covariance[np.ix_(free, free)] = root.T @ root * max(chi_square, 1.0)
    _need_excitation(bundle, np.sqrt(np.diag(covariance)))
    if chi_square > _MISFIT:
        raise FitError(
            WHAT,
            "views that agree with one camera and one grasp",
            f"a misfit {chi_square:.0f} times what the sigmas allow",
            "See whether the object slipped in the fingers, and whether sizes and heights of the tags are as told.",
        )
    arm_errors = np.full((n_views, 3), np.nan)
    arm_errors[list(bundle.views)] = z[SHARE + 1 : SHARE + 1 + bundle.n_arm].reshape(-1, 3)
    has_table = bool(free[TABLE].all())
    heights = sorted({g.height for g in bundle.carried})
    held = [
        f"distance of the task plane along its normal: by the carried tag's height, {heights[0] * 1e3:g} mm",
        "tilt of the carried tag out of the plane: none",
        "focal lengths and lens: those of the camera that was given",
    ]
    return HandEyeFit(
        camera=bundle.camera_at(z),
        camera_covariance=covariance[CAMERA, CAMERA],
        X_ee_B=z[OBJECT].copy(),
        X_ee_B_covariance=covariance[OBJECT, OBJECT],
        X_W_table=z[TABLE].copy() if has_table else None,
        X_W_table_covariance=covariance[TABLE, TABLE] if has_table else None,
        sag_share=float(z[SHARE]),
        arm_errors=arm_errors,
        rms_px=float(np.sqrt(2 * np.mean((residual[: bundle.pixels.size] * bundle.corner_sigma) ** 2))),
        chi_square=chi_square,
        n_views=len(bundle.views),
        rejected=tuple(k for k in range(n_views) if k not in bundle.views),
        held=tuple(held),
    )


def _need_excitation(bundle: Bundle, sigma: Array) -> None:
    limit = np.where(np.isin(np.arange(SHARE), _ANGLES), _ANGLE_LIMIT, _POSITION_LIMIT)
    open_ = [name for name, value, most in zip(_MAIN, sigma, limit, strict=False) if not value < most]
    if not open_:
        return
    x, y, theta = np.ptp(bundle.X_W_ee, axis=0)
    raise FitError(
        WHAT,
        "motions that fix camera, object and table",
        f"{', '.join(open_)} left open: the ee moved by {x * 1e3:.0f} mm in x, {y * 1e3:.0f} mm in y, "
        f"{np.degrees(theta):.1f}° in angle over {len(bundle.views)} views",
        "Move over the whole picture and turn the ee by 20° or more either way.",
    )
