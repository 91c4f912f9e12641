"""The deformation field of a Soft Bubble's depth picture, and the flat face that is pressed into it.

The membrane lies flat on the face, and past an edge of the face it bulges beyond the face's plane, as the gas behind
it pushes: so what counts is the depth against that plane, which in inverse depth is linear in the pixels. Where the
membrane leaves the face without an edge it falls away from the plane the other way, with no kink.

A picture that is of no use is an `Unusable`, which says why; nothing here raises for what a picture may show.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation import strip_kernels as kernels
from estimation.contact_memory import LEAST_AREA, ContactMemory, Touch
from estimation.tactile_pose import FingerModel, PoseStatus
from estimation.torn_depth import MOST_OUTWARD, torn
from mechanics.readings import Array, ImageReading, Stamp, Status

Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

#: columns beyond which pictures are binned: the membrane has no detail that needs more
MOST_COLUMNS = 320
#: least depth of a touch, where one picture is all there is [m] ...
LEAST_TOUCH = 0.9e-3
#: ... and of a face whose edges may show [m]
LEAST_DEEP = 6e-3
#: least area of a flat patch [m²]
LEAST_PATCH = 2e-4
#: −∇²z of a membrane where too little of it is known [1/m]
USUAL_CURVATURE = 60.0
#: scales of the rounds in which the face's plane is fitted [m]
_NARROWER = np.array([2e-3, 1.5e-3, 1e-3, 0.7e-3, 0.7e-3, 0.5e-3, 0.5e-3])
#: half of the stretch over which the membrane's curvature is taken [m]
CURVED_OVER = 10e-3


@dataclass(frozen=True)
class Unusable:
    """Why a picture tells nothing of the held object."""

    status: PoseStatus
    reason: str


@dataclass(frozen=True, eq=False)
class Untouched:
    """A finger's untouched membrane, (h, w): its ``depth`` [m] and where that is ``valid``.

    What is constant in the camera's errors is not in it. ``across`` (w,) and ``down`` (h, 1) are the slopes of the
    pixels' rays; ``turn`` (2, 3) takes the camera's axes to x and y of F.
    """

    depth: Image
    valid: Mask
    across: Image
    down: Image
    turn: Array


@dataclass(frozen=True, eq=False)
class Deformation:
    """One picture's deformation field; arrays are (h, w), binned to at most `MOST_COLUMNS`.

    ``inward`` [m] is how far each pixel has come toward the camera, ``beyond`` [m] how much deeper than the plane of
    the face it is, both with holes filled; ``valid`` whether it was measured, ``flat`` whether the membrane lies on the
    face there. ``plane`` (3,): z = p0 + p1 x + p2 y of the face in the finger's frame F [m]. ``to_pixels``
    (3, 3) takes (x, y, 1) of F on that plane to pixels of these arrays. ``noise`` [m] is a pixel's standard deviation
    and ``alike`` how many pixels share one error: the variance of a mean of n of them is noise² · alike / n.
    """

    inward: Image
    beyond: Image
    valid: Mask
    flat: Mask
    plane: Array
    to_pixels: Array
    noise: float
    alike: float
    untouched: Untouched

    @property
    def pitch(self) -> float:
        """Distance [m] of neighbouring pixels on the face."""
        return float(1.0 / np.sqrt(abs(np.linalg.det(self.to_pixels[:2, :2])) / self.to_pixels[2, 2] ** 2))

    @property
    def picture(self) -> NDArray[np.uint8]:
        """Where the membrane lies on the face (h, w): 255 on its plane, 0 from a millimetre off it."""
        off = np.abs(cv2.blur(self.beyond, (3, 3)))
        return np.asarray(cv2.convertScaleAbs(np.maximum(1e-3 - off, 0.0), alpha=255e3), np.uint8)

    def pixels(self, p_F: ArrayLike) -> Array:
        """Pixels (..., 2), column and row, of points (..., 2) [m] of the face in F's x and y."""
        q = np.asarray(p_F, float) @ self.to_pixels[:, :2].T + self.to_pixels[:, 2]
        return q[..., :2] / q[..., 2:]

    def points(self, pixels: ArrayLike) -> Array:
        """Points (..., 2) [m] of the face in F's x and y; the inverse of `pixels`."""
        back = np.linalg.inv(self.to_pixels)
        q = np.asarray(pixels, float) @ back[:, :2].T + back[:, 2]
        return q[..., :2] / q[..., 2:]

    def curvature(self, p_F: Array) -> float:
        """−∇²z [1/m] of the untouched membrane at a point (2,) [m] of F: that of the paraboloid about it."""
        bare = self.untouched
        column, row = self.pixels(p_F)
        reach = CURVED_OVER / self.pitch
        rows, columns = bare.depth.shape
        top, bottom = (int(np.clip(row + s * reach, 0, rows)) for s in (-1, 1))
        left, right = (int(np.clip(column + s * reach, 0, columns)) for s in (-1, 1))
        part = np.s_[top:bottom:3, left:right:3]
        valid = bare.valid[part]
        if valid.sum() < 20:
            return USUAL_CURVATURE
        z = bare.depth[part].astype(float)
        x = (z * bare.across[left:right:3])[valid]
        y = (z * bare.down[top:bottom:3])[valid]
        x, y = x - x.mean(), y - y.mean()
        A = np.column_stack((np.ones(len(x)), x, y, x * x, x * y, y * y))
        w = np.linalg.solve(A.T @ A + 1e-18 * np.eye(6), A.T @ z[valid])
        return float(np.clip(-2 * (w[3] + w[5]), 0.0, 4 * USUAL_CURVATURE))


class DepthReader:
    """Reads pictures of one finger against its untouched reference.

    With a ``memory`` it tells a touch from the trace of a former one, where the pictures come in their order; without,
    each picture is read by itself.
    """

    def __init__(self, finger: FingerModel, memory: ContactMemory | None = None):
        """``memory`` of this finger alone. Raises ValueError for a finger whose pictures are not depths."""
        reference = finger.reference
        if reference.dtype != np.uint16 or reference.ndim != 2:
            raise ValueError(
                f"{finger.sensor}: its reference is {reference.dtype} of shape {reference.shape}; expected a depth "
                f"picture, uint16 (h, w)"
            )
        self._finger, self._memory = finger, memory
        self._unit = np.float32(finger.described.get("depth_unit", 1e-4))
        self._remap = _rectifying(finger)
        self._factor = -(-finger.camera.width // MOST_COLUMNS)
        binned, valid = self._binned(reference)
        K = finger.camera.K.copy()
        K[:2, :2] /= self._factor
        K[:2, 2] = (K[:2, 2] + 0.5) / self._factor - 0.5
        rows, columns = binned.shape
        self._K = K
        self._across = ((np.arange(columns) - K[0, 2]) / K[0, 0]).astype(np.float32)
        self._down = ((np.arange(rows) - K[1, 2]) / K[1, 1]).astype(np.float32)[:, None]
        self._seen = valid
        self._rim = valid & ~(cv2.erode(np.pad(valid, 1).astype(np.uint8), np.ones((9, 9)))[1:-1, 1:-1] > 0)
        # what is constant in a stereo camera's errors is in the reference too, and finer than any dome
        self._smooth = _smoothed(binned, valid, columns / 40)
        self._constant = np.where(valid, binned - self._smooth, 0).astype(np.float32)
        self._constant -= _smoothed(self._constant, valid, columns / 40)  # a dome is curved, its blur lies inside it
        self._reference = np.where(valid, binned - self._constant, self._smooth).astype(np.float32)
        turn = finger.camera.X_WC[:2, :3]
        self._spacing = self._pitch(self._reference, valid)
        self._untouched = Untouched(self._reference, valid, self._across, self._down, turn)

    def read(self, image: ImageReading) -> Deformation | Unusable:
        """The deformation field, or why there is none."""
        picture = image.image
        trouble = self._distrusted(image)
        if trouble is not None:
            return trouble
        depth, valid = self._binned(picture)
        valid &= self._seen
        depth -= self._constant
        damage = torn(np.where(valid, self._reference - depth, 0), valid, self._seen, self._pitch(depth, valid))
        if damage:
            return Unusable(PoseStatus.TORN, damage)
        rim = valid & self._rim
        if rim.any() and (off := abs(float(np.median((self._reference - depth)[rim])))) > MOST_OUTWARD:
            return Unusable(
                PoseStatus.UNTRUSTED,
                f"where nothing presses, the membrane is {1e3 * off:.0f} mm from where it was; take the reference anew",
            )
        # a pixel that jumps has no neighbour that agrees
        calm = cv2.medianBlur(_filled(depth, valid), 3 if self._factor > 1 else 5)
        valid &= np.abs(depth - calm) < 1.5e-3
        depth = _filled(depth, valid)
        inward = self._reference - depth
        return self._against_face(depth, inward, valid, image.stamp)

    def _distrusted(self, image: ImageReading) -> Unusable | None:
        """What the reading says of itself, and a picture of one depth."""
        picture, reference = image.image, self._finger.reference
        status = image.stamp.status
        if status is Status.NO_CONTACT:
            return Unusable(PoseStatus.NO_CONTACT, "the finger says that it holds nothing")
        if status is Status.SATURATED:
            return Unusable(PoseStatus.SATURATED, "the finger says that its picture is at the end of its range")
        if status is not Status.OK:
            return Unusable(PoseStatus.UNTRUSTED, f"the reading is {status.name.lower()}")
        if picture.shape != reference.shape or picture.dtype != reference.dtype:
            return Unusable(
                PoseStatus.UNTRUSTED,
                f"the picture is {picture.dtype} of shape {picture.shape}, the reference {reference.dtype} of shape "
                f"{reference.shape}",
            )
        own = picture[reference > 0]
        missing = float((own == 0).mean())
        low, high = int(own.min()), int(own.max())
        if low == high or missing > 0.95:
            return Unusable(PoseStatus.BLANK, "the whole picture has one depth" if low == high else "no depth at all")
        end = float((own == np.iinfo(np.uint16).max).mean())
        if end > 0.02:
            return Unusable(PoseStatus.SATURATED, f"{100 * end:.0f} % of the picture are at the end of its range")
        return None

    def _binned(self, picture: NDArray) -> tuple[Image, Mask]:
        """Depth [m] and whether there is one, rectified, each block of pixels as the mean of those that have one."""
        if self._remap is not None:
            picture = cv2.remap(picture, *self._remap, cv2.INTER_NEAREST)
        valid = (picture > 0) & (picture < np.iinfo(np.uint16).max)
        if self._factor == 1:
            return picture * self._unit, valid
        f = self._factor
        rows, columns = (n // f for n in picture.shape)
        part = np.s_[: rows * f, : columns * f]
        count = cv2.resize(valid[part].astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA)
        total = cv2.resize(
            np.where(valid, picture, 0)[part].astype(np.float32), (columns, rows), interpolation=cv2.INTER_AREA
        )
        return np.asarray(total / np.maximum(count, 1e-3) * self._unit, np.float32), count > 0.5

    def _pitch(self, depth: Image, valid: Mask) -> float:
        return float(np.median(depth[valid][::7])) / self._K[0, 0] if valid.any() else 1e-3

    def _against_face(self, depth: Image, inward: Image, valid: Mask, stamp: Stamp) -> Deformation | Unusable:
        known = cv2.blur(valid.astype(np.float32), (5, 5))
        calm = cv2.blur(np.where(valid, inward, np.float32(0)), (5, 5)) / np.maximum(known, 1e-3)
        inner = cv2.erode(self._seen.astype(np.uint8), np.ones((5, 5))) > 0
        touched = _largest(inner & (known > 0.5) & (calm > LEAST_TOUCH))
        deepest = float(calm[touched].max(initial=0.0))
        area = float(touched.sum()) * self._pitch(depth, valid) ** 2
        touch = Touch(area >= LEAST_AREA, deepest)
        if self._memory is not None:
            touch = self._memory.touch(inward, valid, self._spacing, stamp, touch.found)
        if not touch.found:
            return Unusable(PoseStatus.NO_CONTACT, _why_untouched(area, deepest))
        if deepest < LEAST_DEEP:
            deepest = 1e3 * max(deepest, touch.deepest)
            return Unusable(
                PoseStatus.NO_EDGE, f"pressed in by {deepest:.1f} mm; edges show from some {1e3 * LEAST_DEEP:.0f} mm on"
            )
        weights = _plane(depth, touched & valid, self._across, self._down)
        at_plane = 1.0 / (weights[0] + weights[1] * self._across + weights[2] * self._down)
        beyond = (depth - at_plane).astype(np.float32)
        flat, noise, alike = _flatness(beyond, touched, valid)
        area = float(flat.sum()) * (float(np.median(at_plane[flat])) / self._K[0, 0]) ** 2 if flat.any() else 0.0
        if area < LEAST_PATCH:
            return Unusable(PoseStatus.NO_EDGE, f"what presses is flat on {1e4 * area:.1f} cm² only; no face")
        plane, to_pixels = self._geometry(weights)
        return Deformation(inward, beyond, valid, flat, plane, to_pixels, noise, alike, self._untouched)

    def _geometry(self, weights: Array) -> tuple[Array, Array]:
        """The face's plane in F, and the homography from its x and y to pixels."""
        X_FC = self._finger.camera.X_WC
        # 1/z = w·(1, X/z, Y/z) in the camera: w0 z + w1 X + w2 Y = 1
        normal_C = np.array([weights[1], weights[2], weights[0]])
        normal = X_FC[:3, :3] @ normal_C
        level = 1.0 + normal @ X_FC[:3, 3]
        plane = np.array([level, -normal[0], -normal[1]]) / normal[2]
        lift = np.array([[1, 0, 0], [0, 1, 0], [plane[1], plane[2], plane[0]], [0, 0, 1]])
        to_pixels = self._K @ self._finger.camera.X_CW[:3] @ lift
        return plane, to_pixels / to_pixels[2, 2]


def _why_untouched(area: float, deepest: float) -> str:
    if area < LEAST_AREA:
        return f"nothing presses the membrane in by {1e3 * LEAST_TOUCH:.1f} mm anywhere, or newly"
    return f"the membrane is {1e3 * deepest:.1f} mm in, and that is what a former touch has left"


def _rectifying(finger: FingerModel) -> tuple[NDArray, NDArray] | None:
    """Maps that take the lens's distortion out of a picture; None where there is none."""
    camera = finger.camera
    if not camera.distortion.any():
        return None
    return cv2.initUndistortRectifyMap(
        camera.K, camera.distortion, None, camera.K, (camera.width, camera.height), cv2.CV_32FC1
    )


def _smoothed(image: Image, valid: Mask, sigma: float) -> Image:
    """Gaussian mean of what is valid."""
    weight = cv2.GaussianBlur(valid.astype(np.float32), (0, 0), sigma)
    blurred = cv2.GaussianBlur(np.where(valid, image, np.float32(0)), (0, 0), sigma)
    return np.asarray(blurred / np.maximum(weight, 1e-6), np.float32)


def _filled(image: Image, valid: Mask) -> Image:
    """The image with its holes filled from around them, farther out the larger they are."""
    if valid.all():
        return image
    out, left = np.where(valid, image, np.float32(0)), ~valid
    known = valid.astype(np.float32)
    for size in (3, 7, 15, 31, 63):
        weight = cv2.blur(known, (size, size))
        mean = cv2.blur(out * known, (size, size)) / np.maximum(weight, 1e-6)
        near = left & (weight > 0.1)
        out = np.where(near, mean, out)
        left &= ~near
        if not left.any():
            break
    return np.asarray(out, np.float32)


def _largest(mask: Mask) -> Mask:
    """The largest connected part of it."""
    _, labels, figures, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    if len(figures) < 2:
        return mask
    return labels == 1 + int(figures[1:, cv2.CC_STAT_AREA].argmax())


def _plane(depth: Image, touched: Mask, across: Image, down: Image) -> Array:
    """Weights (3,) of inverse depth over (1, X/z, Y/z): the plane that most of the touched pixels lie on."""
    rows, columns = np.nonzero(touched)
    rows, columns = rows[::3], columns[::3]
    z = depth[rows, columns].astype(float)
    counts, edges = np.histogram(z, bins=np.arange(z.min() - 5e-4, z.max() + 1e-3, 2.5e-4))
    counts = np.convolve(counts, np.ones(3), "same")
    best = int(counts.argmax())
    w = np.array([2.0 / (edges[best] + edges[best + 1]), 0.0, 0.0])
    kernels.inverse_depth_plane(z, across[columns].astype(float), down[rows, 0].astype(float), _NARROWER, w)
    return w


def _flatness(beyond: Image, touched: Mask, valid: Mask) -> tuple[Mask, float, float]:
    """Where the membrane lies on the plane; a pixel's noise there and how many pixels share one error."""
    calm = cv2.blur(beyond, (5, 5))
    spread = 1.4826 * float(np.median(np.abs(beyond[touched & (np.abs(calm) < 5e-4)]))) if touched.any() else 3e-4
    flat = touched & (np.abs(calm) < max(1.2 * spread, 2e-4))
    flat = cv2.morphologyEx(flat.astype(np.uint8), cv2.MORPH_OPEN, np.ones((5, 5))) > 0
    inside = (cv2.erode(flat.astype(np.uint8), np.ones((5, 5))) > 0) & valid
    if inside.sum() < 80:
        return flat, max(spread, 2e-5), 4.0
    weight = inside.astype(np.float32)
    trend = cv2.blur(beyond * weight, (41, 41)) / np.maximum(cv2.blur(weight, (41, 41)), 1e-3)
    own = (beyond - trend) * weight
    noise = max(float(np.sqrt((own**2).sum() / weight.sum())), 2e-5)
    share = cv2.blur(weight, (7, 7))
    whole = share > 0.9
    if not whole.any():
        return flat, noise, 4.0
    block = cv2.blur(own, (7, 7))[whole] / share[whole]
    alike = 49 * float(np.mean(block**2)) / noise**2
    return flat, noise, float(np.clip(alike, 1.0, 60.0))
