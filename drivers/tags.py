"""AprilTags in images: their bit patterns, and a detector with sub-pixel corners.

The corners of the AprilTag library scatter by a tenth of a pixel and more: it fits its quads to thresholded pixels. So
each edge of the black square is located again in the grey image (`refine_corners`), which brings them to a hundredth.
"""

from __future__ import annotations

import threading
import weakref
from collections.abc import Collection, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers import tag_edges
from drivers.errors import NotConnected
from mechanics.camera import CameraModel
from mechanics.readings import Array, TagDetection

Image = NDArray[np.uint8]
Region = tuple[int, int, int, int]

# Cells across the black square, and OpenCV's name of the same code.
_FAMILIES = {
    "tag36h11": (8, "DICT_APRILTAG_36h11"),
    "tag25h9": (7, "DICT_APRILTAG_25h9"),
    "tag16h5": (6, "DICT_APRILTAG_16h5"),
}
_PASSES, _SETTLED = 5, 0.01  # of the refinement; it ends when no corner moved by more than that [px]
_ROOM, _NEAR = 0.3, 0.15  # of a tag's size: so far around it `track` looks for it again, and so far it may have gone
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

        if refine:
            tag_edges.warm()  # a picture is waited for with less patience than a detector
        self.family = family
        self._cells = _family(family)[0]
        self._decimate, self._refine, self._max_hamming = decimate, refine, max_hamming
        self._camera = camera
        self._lock = threading.Lock()
        self._seen: dict[int, TagDetection] = {}  # by `track`, in its last picture
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

    def track(self, image: Image, ids: Collection[int]) -> tuple[TagDetection, ...]:
        """Tags in ``image`` as `detect` finds them, looked for first where each of ``ids`` was seen last.

        Where one of them is not found again, or the others are not these alone, nobody knows what has changed: then the
        whole picture is searched. So name all the tags that may be in view: any other may be overlooked.
        """
        found = self._again(image, ids) or self.detect(image)
        self._seen = {d.id: d for d in found}
        return found

    def _again(self, image: Image, ids: Collection[int]) -> tuple[TagDetection, ...]:
        """The tags ``ids`` near where they were, or nothing."""
        last = self._seen
        if not all(id in last for id in ids):
            return ()
        found = self.detect(image, regions_around([last[id] for id in ids], _ROOM))
        there = sorted(d.id for d in found) == sorted(ids) and all(_stayed(d, last[d.id]) for d in found)
        return found if there else ()

    def forget(self) -> None:
        """What `track` has seen until now tells nothing of the next picture."""
        self._seen = {}

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
    # one kind of array, whoever made it: for each the loops would be compiled anew
    image = np.ascontiguousarray(image).view()
    image.setflags(write=False)
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
    start, along, length = _edges(corners)
    count = int(np.clip(np.ceil(length.max()), 16, 128))
    steps = int(np.ceil(reach.max() / 0.25))
    points, valid = np.empty((*length.shape, count, 2)), np.empty((*length.shape, count), bool)
    tag_edges.edge_points(image, start, along, length, reach, steps, points, valid)
    if camera is not None:
        points = camera.undistort(points)
        start, along, _ = _edges(camera.undistort(corners))
    origin, direction = np.empty_like(start), np.empty_like(start)
    tag_edges.edge_lines(points, valid, start, along, origin, direction)
    enough = (valid.mean(axis=-1) > 0.4).all(axis=-1)
    out = _intersections(origin, direction)
    out[~enough] = np.nan
    return out if camera is None else camera.distort(out)


def _edges(corners: Array) -> tuple[Array, Array, Array]:
    """Edges from each corner (n, 4, 2) to the next: where they begin, unit vectors along them, and lengths (n, 4)."""
    sides = np.roll(corners, -1, axis=1) - corners
    length = np.linalg.norm(sides, axis=-1)
    return np.ascontiguousarray(corners), sides / length[..., None], length


def _intersections(origin: Array, direction: Array) -> Array:
    """Corner i (n, 4, 2) where line i − 1 meets line i."""
    o0, d0 = np.roll(origin, 1, axis=1), np.roll(direction, 1, axis=1)
    gap = origin - o0
    cross = d0[..., 0] * direction[..., 1] - d0[..., 1] * direction[..., 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (gap[..., 0] * direction[..., 1] - gap[..., 1] * direction[..., 0]) / cross
    return o0 + s[..., None] * d0


def _family(name: str) -> tuple[int, str]:
    if name not in _FAMILIES:
        raise ValueError(f"unknown tag family {name!r}; expected one of {', '.join(_FAMILIES)}")
    return _FAMILIES[name]


def _stayed(now: TagDetection, before: TagDetection) -> bool:
    """Whether a tag is near where it was: one that the border of its region cuts off can be read, but not measured."""
    size = float(np.ptp(before.corners, axis=0).max())
    return float(np.abs(now.corners - before.corners).max()) < _NEAR * size


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
