"""What the camera behind a gel sees: coloured lights on its pressed surface, and the markers printed on it.

Lambert's law with three lights near the gel; the surface is seen in perspective through a lens that bends. Coordinates
are those of `drivers.sim.gel`, in which the camera stands at positive z.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.finger_frames import gel_camera
from drivers.sim.gel import Floats, PressedGel, at_rest
from mechanics.camera import CameraModel
from mechanics.readings import Array

Picture = NDArray[np.float32]

_NEWTON_STEPS = 2


@dataclass(frozen=True)
class Light:
    """A light: where it stands [m], where its brightest spot on the gel is [m], how wide that is, its colour.

    ``width`` [m] is the standard deviation of the spot, ``colour`` its blue, green and red at the brightest point in
    grey levels.
    """

    position: tuple[float, float, float]
    spot: tuple[float, float]
    width: float
    colour: tuple[float, float, float]


@dataclass(frozen=True)
class GelSlimOptics:
    """The optics of a GelSlim 3.0 finger; lengths in m. Its view, marker pitch and colours are those of real pictures.

    The camera is ``distance`` above the gel, tilted by ``tilt`` [rad] so that it sees the lower rows from nearer, and
    sees ``view`` across its picture's width. ``bend`` is the radial distortion k1, ``blur`` the standard deviation of
    the lens' blur on the gel. A marker is an ellipse with half axes ``marker`` that takes away ``darkness`` of the
    light, on a grid of ``pitch``.
    """

    view: float = 45.2e-3
    distance: float = 40e-3
    tilt: float = 0.06
    bend: float = 0.12
    blur: float = 0.06e-3
    pitch: float = 2.3e-3
    marker: tuple[float, float] = (0.42e-3, 0.28e-3)
    darkness: float = 0.6
    ambient: tuple[float, float, float] = (5.0, 5.0, 5.0)
    lights: tuple[Light, ...] = (
        Light((0.016, 0.028, 0.006), (0.006, 0.013), 0.0120, (195.0, 105.0, 70.0)),
        Light((-0.034, -0.008, 0.006), (-0.014, -0.002), 0.0105, (135.0, 160.0, 70.0)),
        Light((0.030, -0.016, 0.006), (0.006, -0.011), 0.0105, (100.0, 85.0, 190.0)),
    )

    def camera(self, width: int, height: int) -> CameraModel:
        """The camera with a picture of ``width`` by ``height`` pixels; its world is the finger's frame."""
        return gel_camera(width, height, view=self.view, distance=self.distance, tilt=self.tilt, bend=self.bend)

    def markers(self, width: int, height: int) -> Array:
        """Where the markers are in the gel at rest (n, 2) [m], row by row: a grid about the origin wider than the view.

        It goes on outside the picture, from where a shear may bring them.
        """
        half = np.array([0.5, 0.5 * height / width]) * self.view
        x, y = (self.pitch * np.arange(-n, n + 1) for n in np.ceil(half / self.pitch + 2).astype(int))
        return np.stack(np.meshgrid(x, y[::-1]), axis=-1).reshape(-1, 2)


class GelRenderer:
    """Pictures of a gel, (height, width, 3) float32 in grey levels, blue first. It keeps nothing between pictures."""

    def __init__(self, optics: GelSlimOptics, width: int, height: int):
        self.optics, self.camera = optics, optics.camera(width, height)
        self.markers = optics.markers(width, height)
        self._blur = max(0.3, optics.blur * width / optics.view)
        self._see_rays()
        self._light()
        # pixels about a marker's centre that may have ink: 1.65 half axes, turned by up to a quarter of a radian
        along, across = np.array(optics.marker) * width / optics.view
        x, y = (int(np.ceil(1.65 * np.hypot(*half) + 0.5)) for half in ((along, across / 4), (across, along / 4)))
        self._window = np.stack(np.meshgrid(np.arange(-x, x + 1), np.arange(-y, y + 1)), axis=-1).reshape(-1, 2)
        self._untouched = self._finished(self._flat.copy(), at_rest(self._corners_of_markers()))

    def render(self, gel: PressedGel | None) -> Picture:
        """The gel as it is seen; None: nothing touches it."""
        if gel is None:
            return self._untouched.copy()
        picture = self._flat.copy()
        self._shade(picture, gel)
        return self._finished(picture, gel.carried(self._corners_of_markers()))

    # -- the surface ---------------------------------------------------------------------------------------------------

    def _see_rays(self) -> None:
        """Where each pixel's ray meets the gel at rest, and how far it moves sideways per height above that."""
        camera = self.camera
        grid = np.stack(np.meshgrid(np.arange(camera.width), np.arange(camera.height)), axis=-1).astype(float)
        ideal = camera.undistort(grid)
        rays_C = np.concatenate((ideal, np.ones((*ideal.shape[:2], 1))), axis=-1) @ np.linalg.inv(camera.K).T
        rays = rays_C @ camera.X_WC[:3, :3].T
        sideways = rays[..., :2] / rays[..., 2:]
        self._steepest = float(np.linalg.norm(sideways, axis=-1).max())
        self._sideways: Picture = sideways.astype(np.float32)
        self._seen: Picture = (camera.X_WC[:2, 3] - camera.X_WC[2, 3] * sideways).astype(np.float32)

    def _light(self) -> None:
        """The picture of the bare gel, and from where and how brightly each light falls on what a pixel sees."""
        self._lean, self._strength = [], []
        flat = np.broadcast_to(np.array(self.optics.ambient), (*self._seen.shape[:2], 3)).copy()
        for light in self.optics.lights:
            lean = (np.array(light.position[:2]) - self._seen) / light.position[2]
            off = ((self._seen - light.spot) ** 2).sum(axis=-1, keepdims=True)
            strength = np.exp(-0.5 * off / light.width**2) * np.array(light.colour)
            flat += strength
            self._lean.append(lean.reshape(-1, 2).astype(np.float32))
            self._strength.append(strength.reshape(-1, 3).astype(np.float32))
        self._flat: Picture = flat.astype(np.float32)

    def _shade(self, picture: Picture, gel: PressedGel) -> None:
        """Turn the light where the surface is not level."""
        pad = gel.pad
        shift = gel.depth * self._steepest
        distance, gradient = gel.distance(self._seen)
        active = np.flatnonzero((distance > -shift - 4 * pad.rounding) & (distance < shift + 7 * pad.wall))
        if not len(active):
            return
        at_zero = gel.height_at(distance.ravel()[active], np.take(gradient.reshape(-1, 2), active, axis=0))
        q, sideways = (np.take(rays.reshape(-1, 2), active, axis=0) for rays in (self._seen, self._sideways))
        slope = _meet(gel, at_zero, q, sideways)
        length = np.sqrt(1 + slope[:, 0] ** 2 + slope[:, 1] ** 2)
        change = np.zeros((len(active), 3), np.float32)
        for lean, strength in zip(self._lean, self._strength, strict=True):
            # Lambert's cosine over that of the level surface; the light leans by (x, y) per height
            lx, ly = np.take(lean, active, axis=0).T
            ratio = np.maximum(1 - slope[:, 0] * lx - slope[:, 1] * ly, 0.0) / length
            change += (ratio - 1).astype(np.float32)[:, None] * np.take(strength, active, axis=0)
        picture.reshape(-1, 3)[active] += change

    # -- the markers ---------------------------------------------------------------------------------------------------

    def _corners_of_markers(self) -> Array:
        """Centres of the markers and the ends of their half axes (3, n, 2), in the gel at rest."""
        a, b = self.optics.marker
        return self.markers + np.array([[[0.0, 0.0]], [[a, 0.0]], [[0.0, b]]])

    def _finished(self, picture: Picture, markers: Array) -> Picture:
        """The picture with the markers (3, n, 3), which lie on the surface, through the lens."""
        width, height = self.camera.width, self.camera.height
        centre, a, b = self.camera.project(markers)
        border = np.abs(self._window).max()
        seen = ((centre > -border) & (centre < (width + border, height + border))).all(axis=-1)
        centre, a, b = centre[seen], a[seen] - centre[seen], b[seen] - centre[seen]
        nearest = np.rint(centre).astype(int)
        columns, rows = (nearest[:, i, None] + self._window[:, i] for i in (0, 1))
        x, y = columns - centre[:, 0, None], rows - centre[:, 1, None]
        area = (a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])[:, None]
        along = (b[:, 1, None] * x - b[:, 0, None] * y) / area  # in half axes
        across = (a[:, 0, None] * y - a[:, 1, None] * x) / area
        ink = np.exp(-0.7 * (along * along + across * across) ** 2)
        ink[(columns < 0) | (columns >= width) | (rows < 0) | (rows >= height)] = 0.0
        index = np.clip(rows, 0, height - 1) * width + np.clip(columns, 0, width - 1)
        ink = np.bincount(index.ravel(), ink.ravel(), width * height)
        left = (1 - self.optics.darkness * np.minimum(ink, 1.0)).astype(np.float32)
        picture *= left.reshape(height, width, 1)
        return cv2.GaussianBlur(picture, (0, 0), self._blur, borderType=cv2.BORDER_REPLICATE)  # pyright: ignore[reportReturnType]


@lru_cache(maxsize=4)
def renderer(optics: GelSlimOptics, width: int, height: int) -> GelRenderer:
    """One renderer for all fingers with the same optics and picture size."""
    return GelRenderer(optics, width, height)


def _meet(gel: PressedGel, at_zero: tuple[Floats, Floats], q: Floats, sideways: Floats) -> Floats:
    """Gradient (n, 2) of the surface where the rays meet it that pass q (n, 2) at height 0.

    ``at_zero`` is the surface's height and gradient at q.
    """
    z = np.zeros(len(q), q.dtype)
    height, slope = at_zero
    for _ in range(_NEWTON_STEPS):
        grazing = 1 - slope[:, 0] * sideways[:, 0] - slope[:, 1] * sideways[:, 1]
        z += (height - z) / np.maximum(grazing, 0.3)  # kept short of a wall that the ray nearly grazes
        np.clip(z, 0.0, gel.depth, out=z)
        height, slope = gel.height(q + z[:, None] * sideways)
    return slope
