"""AprilTags in images: their bit patterns, and a detector with sub-pixel corners.

The corners of the AprilTag library scatter by a tenth of a pixel and more: it fits its quads to thresholded pixels. So
each edge of the black square is located again in the grey image (`refine_corners`), which brings them to a hundredth.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.errors import NotConnected
from mechanics.camera import CameraModel
from mechanics.readings import Array, TagDetection

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Region = tuple[int, int, int, int]

# Cells across the black square, and OpenCV's name of the same code.
_FAMILIES = {
    "tag36h11": (8, "DICT_APRILTAG_36h11"),
    "tag25h9": (7, "DICT_APRILTAG_25h9"),
    "tag16h5": (6, "DICT_APRILTAG_16h5"),
}
_PASSES, _SETTLED = 5, 0.01  # of the refinement; it ends when no corner moved by more than that [px]
_FAINTEST = 8.0  # grey levels between black and white, below which there is no edge
_SMALLEST_REGION = 16  # px; the library needs a few of its 4 px tiles
_APRILTAG_ORIGIN = 0.5  # px; the library puts pixel centres at half-integers


def tag_bitmap(id: int, family: str = "tag36h11") -> Image:
    """Cells of a tag that is seen upright, with its white margin: (10, 10) of 0 or 255 for tag36h11, row 0 on top.

    Raises ValueError for an unknown family or id.
    """
    import cv2

    cells, code = _family(family)
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, code))
    if not 0 <= id < len(dictionary.bytesList):
        raise ValueError(f"{family}: id {id} does not exist; expected 0 to {len(dictionary.bytesList) - 1}")
    # OpenCV draws these tags upside down against AprilRobotics' own pictures.
    picture = np.rot90(cv2.aruco.generateImageMarker(dictionary, id, cells, borderBits=1), 2)
    return np.pad(picture, 1, constant_values=255).astype(np.uint8)


class TagDetector:
    """Finds the tags of one family in grey images. Deterministic; one detection at a time.

    ``decimate`` shrinks the image for the search only (2 is four times as fast and finds tags down to about 25 px), and
    ``blur`` [px] smooths it (0.8 takes the noise out that would start many a vain search: three times as fast);
    ``refine`` locates the edges again at full resolution; with ``camera`` they are straightened against its distortion
    first. More than ``max_hamming`` corrected bits are not a tag.
    """

    def __init__(
        self,
        family: str = "tag36h11",
        *,
        decimate: float = 2.0,
        blur: float = 0.0,
        refine: bool = True,
        max_hamming: int = 1,
        camera: CameraModel | None = None,
    ):
        import pupil_apriltags

        self.family = family
        self._cells = _family(family)[0]
        self._decimate, self._refine, self._max_hamming = decimate, refine, max_hamming
        self._camera = camera
        self._lock = threading.Lock()
        # The library's own edge refinement pays only where the search image is smaller than the picture: at full size
        # it moves corners by half a pixel and loses small tags. The binding rounds the sharpening down to none.
        self._library: Any = pupil_apriltags.Detector(
            families=family, nthreads=1, quad_decimate=decimate, quad_sigma=blur, refine_edges=int(decimate > 1)
        )
        self._library.tag_detector_ptr.contents.decode_sharpening = 0.25
        self._close = weakref.finalize(self, _destroy, self._library)

    def detect(self, image: Image, regions: Iterable[Region] | None = None) -> tuple[TagDetection, ...]:
        """Tags in ``image`` (h, w) uint8, sorted by id; only within ``regions`` (x0, y0, x1, y1) [px] where given.

        Raises ValueError on another kind of image, NotConnected after `close`.
        """
        if image.ndim != 2 or image.dtype != np.uint8:
            raise ValueError(f"tag detection: expected an (h, w) uint8 image, got {image.shape} {image.dtype}")
        height, width = image.shape
        boxes = [(0, 0, width, height)] if regions is None else [_clipped(r, width, height) for r in regions]
        found: list[TagDetection] = []
        with self._lock:
            if not self._close.alive:
                raise NotConnected("tag detector", "detect", "it was closed", "Make a new TagDetector")
            for x0, y0, x1, y1 in boxes:
                if min(x1 - x0, y1 - y0) < _SMALLEST_REGION:
                    continue
                for tag in self._library.detect(image[y0:y1, x0:x1]):
                    if tag.hamming <= self._max_hamming:
                        corners = tag.corners + np.array([x0, y0]) - _APRILTAG_ORIGIN
                        found.append(TagDetection(tag.tag_id, corners, tag.hamming, float(tag.decision_margin)))
        found = _without_duplicates(found)
        if self._refine and found:
            corners = refine_corners(
                image,
                np.stack([d.corners for d in found]),
                cells=self._cells,
                max_shift=0.5 + self._decimate,
                camera=self._camera,
            )
            found = [TagDetection(d.id, c, d.hamming, d.margin) for d, c in zip(found, corners, strict=True)]
        return tuple(sorted(found, key=lambda d: (d.id, *d.corners[0])))

    def close(self) -> None:
        """Free the library's detector; idempotent. It also goes with this object, and at exit."""
        with self._lock:
            self._close()


def regions_around(detections: Sequence[TagDetection], margin: float = 0.5) -> list[Region]:
    """A region (x0, y0, x1, y1) [px] per detection, its box grown by ``margin`` of its size, to look there next."""
    out: list[Region] = []
    for detection in detections:
        low, high = detection.corners.min(axis=0), detection.corners.max(axis=0)
        grow = margin * float((high - low).max())
        (x0, y0), (x1, y1) = np.floor(low - grow).astype(int), np.ceil(high + grow).astype(int) + 1
        out.append((int(x0), int(y0), int(x1), int(y1)))
    return out


def refine_corners(
    image: Image, corners: Array, *, cells: int = 8, max_shift: float = 2.5, camera: CameraModel | None = None
) -> Array:
    """Corners (n, 4, 2) [px] where the edges of the black squares of ``cells`` cells meet, from rough ``corners``.

    The image is sampled along normals of each edge; an edge lies where the grey values on both sides of it balance,
    which is exact for any symmetric blur; a line is fitted to what was found, without outliers; neighbours are
    intersected. A tag that is too small, or has an edge that cannot be seen, or would move by more than ``max_shift``
    pixels keeps its rough corners.
    """
    corners = np.asarray(corners, float)
    sides = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=-1)
    reach = np.minimum(0.45 * sides.min(axis=1) / cells, 3.0)
    good = reach >= 1.0
    refined = corners.copy()
    for _ in range(_PASSES):  # each is centred on the edges that the last one found: there the balance has no bias
        if not good.any():
            break
        before = refined[good]
        refined[good] = after = _refine_once(image, before, reach[good], camera)
        good &= np.isfinite(refined).all(axis=(1, 2))
        if not np.nanmax(np.abs(after - before), initial=0.0) > _SETTLED:
            break
    moved = np.linalg.norm(refined - corners, axis=-1).max(axis=1)
    return np.where((good & (moved <= max_shift))[:, None, None], refined, corners)


def _refine_once(image: Image, corners: Array, reach: Array, camera: CameraModel | None) -> Array:
    """One pass over corners (n, 4, 2); NaN where a tag's edges cannot be seen."""
    start, end = corners, np.roll(corners, -1, axis=1)
    length = np.linalg.norm(end - start, axis=-1)
    along = (end - start) / length[..., None]
    # Corners run counter-clockwise as seen, so in pixel axes (y down) the outside lies on this side.
    outward = np.stack((-along[..., 1], along[..., 0]), axis=-1)

    count = int(np.clip(np.ceil(length.max()), 16, 128))
    margin = (reach[:, None] + 1.0)[..., None]
    t = margin + (length[..., None] - 2 * margin) * (np.arange(count) + 0.5) / count  # (n, 4, count)
    n_steps = int(np.ceil(reach.max() / 0.25))
    step = 2 * reach / n_steps
    # Shifting each profile by a part of a step keeps an edge that runs along the pixel grid from a common rounding.
    shift = step[:, None] * (np.modf(np.arange(count) * 0.6180339887)[0] - 0.5)
    middle = step[:, None] * (np.arange(n_steps) + 0.5) - reach[:, None]
    s = (middle[:, None, :] + shift[..., None])[:, None]  # (n, 1, count, n_steps)
    foot = start[..., None, :] + t[..., None] * along[..., None, :]
    grey, inside = _bilinear(image, foot[..., None, :] + s[..., None] * outward[..., None, None, :])

    ends = max(1, n_steps // 6)
    valid: Mask = np.asarray(inside.all(axis=-1))
    black, valid = _level(t, grey[..., :ends].mean(axis=-1), valid, 2.0)
    white, valid = _level(t, grey[..., -ends:].mean(axis=-1), valid, 2.0)
    contrast = white - black
    with np.errstate(divide="ignore", invalid="ignore"):
        filled = (grey - black[..., None]).sum(axis=-1) / contrast
        offset = (reach[:, None] + shift)[:, None] - step[:, None, None] * filled
    valid &= (contrast > _FAINTEST) & (np.abs(offset) < reach[:, None, None])
    offset = np.where(valid, offset, 0.0)
    points = foot + offset[..., None] * outward[..., None, :]
    if camera is not None:
        points, start, end = camera.undistort(points), camera.undistort(start), camera.undistort(end)
        along = (end - start) / np.linalg.norm(end - start, axis=-1)[..., None]
        outward = np.stack((-along[..., 1], along[..., 0]), axis=-1)

    relative = points - start[..., None, :]
    t, r = (np.einsum("nekc,nec->nek", relative, axis) for axis in (along, outward))
    _, valid = _level(t, r, valid, 0.01)
    enough = (valid.mean(axis=-1) > 0.4).all(axis=-1)
    at_start, slope = _line(t, r, valid)
    direction = along + slope[..., None] * outward
    origin = start + at_start[..., None] * outward
    out = _intersections(origin, direction)
    out[~enough] = np.nan
    return out if camera is None else camera.distort(out)


def _line(t: Array, y: Array, valid: Mask) -> tuple[Array, Array]:
    """Least-squares value at t = 0 and slope of y(t) along the last axis, over the valid samples."""
    n = np.maximum(valid.sum(axis=-1), 1)
    mean_t, mean_y = np.where(valid, t, 0).sum(axis=-1) / n, np.where(valid, y, 0).sum(axis=-1) / n
    dt = np.where(valid, t - mean_t[..., None], 0.0)
    spread = (dt * dt).sum(axis=-1)
    slope = (dt * np.where(valid, y, 0)).sum(axis=-1) / np.where(spread > 0, spread, 1.0)
    return mean_y - slope * mean_t, slope


def _level(t: Array, y: Array, valid: Mask, floor: float) -> tuple[Array, Mask]:
    """The straight line through y(t) at every t, and which of the valid samples it rests on.

    Four rounds drop what lies beyond three median distances (outliers on a fifth of an edge pull the line, but not
    that far); then everything within six comes back, since noise alone would have been trimmed as well. Nothing within
    ``floor`` is dropped.
    """
    kept = valid
    for factor in (3.0, 3.0, 3.0, 3.0, 6.0):
        distance, _ = _distance(t, y, kept)
        ranked = np.sort(np.where(kept, distance, np.inf), axis=-1)
        half = np.maximum(kept.sum(axis=-1, keepdims=True) - 1, 0) // 2
        limit = np.maximum(factor * np.take_along_axis(ranked, half, axis=-1), floor)
        kept = (valid if factor > 3 else kept) & (distance <= limit)
    return _distance(t, y, kept)[1], kept


def _distance(t: Array, y: Array, valid: Mask) -> tuple[Array, Array]:
    """How far each sample lies from the line through the valid ones, and that line at every t."""
    at_zero, slope = _line(t, y, valid)
    fit = at_zero[..., None] + slope[..., None] * t
    return np.abs(y - fit), fit


def _intersections(origin: Array, direction: Array) -> Array:
    """Corner i (n, 4, 2) where line i − 1 meets line i."""
    o0, d0 = np.roll(origin, 1, axis=1), np.roll(direction, 1, axis=1)
    gap = origin - o0
    cross = d0[..., 0] * direction[..., 1] - d0[..., 1] * direction[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (gap[..., 0] * direction[..., 1] - gap[..., 1] * direction[..., 0]) / cross
    return o0 + s[..., None] * d0


def _bilinear(image: Image, points: Array) -> tuple[Array, Mask]:
    """Grey values (...) at points (..., 2) [px], and whether they lie in the image (at its border's value if not)."""
    height, width = image.shape
    x, y = points[..., 0], points[..., 1]
    inside = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    x, y = (np.nan_to_num(np.clip(v, 0, limit)) for v, limit in ((x, width - 1), (y, height - 1)))
    column, row = np.minimum(x.astype(np.intp), width - 2), np.minimum(y.astype(np.intp), height - 2)
    fx, fy = x - column, y - row
    flat, at = image.ravel(), row * width + column
    upper = flat[at] * (1 - fx) + flat[at + 1] * fx
    lower = flat[at + width] * (1 - fx) + flat[at + width + 1] * fx
    return upper * (1 - fy) + lower * fy, inside


def _family(name: str) -> tuple[int, str]:
    if name not in _FAMILIES:
        raise ValueError(f"unknown tag family {name!r}; expected one of {', '.join(_FAMILIES)}")
    return _FAMILIES[name]


def _clipped(region: Region, width: int, height: int) -> Region:
    x0, y0, x1, y1 = region
    return max(0, x0), max(0, y0), min(width, x1), min(height, y1)


def _without_duplicates(found: list[TagDetection]) -> list[TagDetection]:
    """Regions that overlap see a tag twice: keep the sighting with the larger margin."""
    kept: list[TagDetection] = []
    for tag in sorted(found, key=lambda d: -d.margin):
        if not any(tag.id == other.id and np.abs(tag.corners - other.corners).max() < 3.0 for other in kept):
            kept.append(tag)
    return kept


def _destroy(library: Any) -> None:
    """Free the detector, then its families. The binding's own destructor does the reverse and reads freed memory."""
    pointer, library.tag_detector_ptr = library.tag_detector_ptr, None
    if pointer is None:
        return
    library.libc.apriltag_detector_destroy.restype = None
    library.libc.apriltag_detector_destroy(pointer)
    for name, family in library.tag_families.items():
        destroy = getattr(library.libc, f"{name}_destroy")
        destroy.restype = None
        destroy(family)
