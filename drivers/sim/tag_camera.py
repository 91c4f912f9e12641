"""A simulated tag camera: pictures of the tags by exact area coverage, and the detector's view of them.

What leaves this room passed through pixels: the reading is what `drivers.tags.TagDetector` finds in the picture.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.config import TagCameraConfig
from drivers.interfaces import Description, TagCamera
from drivers.scene import TagMount
from drivers.sim import area_coverage
from drivers.sim.camera_errors import actual, calibrated, exposed
from drivers.sim.faults import Faulty, received
from drivers.sim.mismatch import CameraFigures
from drivers.sim.screen import Screen
from drivers.tags import TagDetector, tag_bitmap
from mechanics.camera import CameraModel, point_in_world
from mechanics.readings import Array, ImageReading, Stamp, Status, TagDetection, TagReading
from mechanics.se2 import transform
from mechanics.tag_board import TagBoard

_BLACK, _WHITE, _BACKGROUND = 20.0, 235.0, 128.0  # grey levels of matt print under even light
_FINGER = 70.0
_SMEAR = 0.1  # px of motion while a frame is exposed, below which it is not drawn
_POSES = 5  # of what moves, in one frame


class _Profile(Protocol):
    @property
    def camera(self) -> CameraFigures: ...


class TagWorld(Protocol):
    """What a tag camera needs of the simulated world."""

    lockstep: bool

    @property
    def profile(self) -> _Profile:
        """The mismatch profile."""
        ...

    def now_ns(self) -> int:
        """Present instant [ns]."""
        ...

    def visible_tags(self) -> list[tuple[TagMount, Array]]:
        """Each tag with the pose X_W_body (3,) of the body that carries it."""
        ...

    def tag_twists(self) -> dict[int, Array]:
        """Velocity (3,) in W, (ẋ, ẏ, θ̇), of the bodies that carry tags, by the tag's id; none for what stands."""
        ...

    def screens(self) -> list[Screen]:
        """What stands in front of the tags."""
        ...


class TagRenderer:
    """Draws tags as a camera sees them: each pixel is the mean over its square, exactly.

    Every boundary between a black and a white cell is cut at the pixel grid (`drivers.sim.area_coverage`), so that an
    edge lies in the picture where it lies in the world, to the rounding of grey levels.
    Under lens distortion a cell's edge is drawn as a chord of four.
    """

    def __init__(self, camera: CameraModel):
        self.camera = camera
        self._pieces = 4 if camera.distortion.any() else 1
        area_coverage.warm()  # a picture is waited for with less patience than a camera

    def render(
        self,
        tags: Iterable[tuple[TagMount, Array]],
        screens: Iterable[Screen] = (),
        board: tuple[TagBoard, Array] | None = None,
    ) -> NDArray[np.uint8]:
        """Picture (h, w) of tags on bodies at X_W_body (3,); a tag further in front hides what is behind it.

        Screens hide all tags that they stand in front of, and a board at its X_W_B (4, 4) hides everything behind it.
        """
        return np.rint(self.paint(tags, screens, board)).astype(np.uint8)

    def paint(
        self,
        tags: Iterable[tuple[TagMount, Array]],
        screens: Iterable[Screen] = (),
        board: tuple[TagBoard, Array] | None = None,
    ) -> Array:
        """The same in grey levels, before they are rounded."""
        grey = np.full((self.camera.height, self.camera.width), _BACKGROUND)
        things: list[tuple[float, TagMount | Screen, Array]] = [(mount.height, mount, X_W) for mount, X_W in tags]
        things += [(screen.front, screen, screen.X_W) for screen in screens]
        for _, thing, X_W in sorted(things, key=lambda thing: thing[0]):
            if isinstance(thing, Screen):
                self._cover(grey, thing)
            else:
                self._draw(grey, thing, X_W)
        if board is not None:
            self._show(grey, *board)
        return grey

    def _show(self, grey: Array, board: TagBoard, X_W_B: Array) -> None:
        """The board in front of everything: its paper, and its tags on the side that is printed."""
        R, origin = X_W_B[:3, :3], X_W_B[:3, 3]
        w, h = board.half_size
        corners = np.array([[-w, -h, 0.0], [w, -h, 0.0], [w, h, 0.0], [-w, h, 0.0]])
        # under distortion the paper's edge is a chord per cell, as a tag's is
        pieces = 8 * self._pieces * max(board.columns, board.rows)
        cuts = np.arange(pieces) / pieces
        sides = corners[:, None] + cuts[:, None] * (np.roll(corners, -1, axis=0) - corners)[:, None]
        outline = self.camera.project(sides.reshape(-1, 3) @ R.T + origin)
        if not np.isfinite(outline).all():
            return  # not all of it is in front of the camera
        printed = float(R[:, 2] @ (self.camera.X_WC[:3, 3] - origin)) > 0
        if not printed:
            outline = outline[::-1]
        ones = np.ones(len(outline))
        self._blend(grey, outline, np.roll(outline, -1, axis=0), _WHITE * ones, ones)
        for id in board.ids if printed else ():
            start, end, level, cover = _boundaries(id, self._pieces)
            nodes = np.stack((start, end)) * (board.size / 8) + board.centre(id)
            pixels = self.camera.project(nodes @ R[:, :2].T + origin)
            self._blend(grey, pixels[0], pixels[1], level, cover)

    def _cover(self, grey: Array, screen: Screen) -> None:
        p_W = transform(np.asarray(screen.X_W, float), screen.corners)
        corners = self.camera.project(np.concatenate([point_in_world(p_W, h) for h in (screen.back, screen.front)]))
        if not np.isfinite(corners).all():
            return  # behind the camera
        outline = cv2.convexHull(corners.astype(np.float32), clockwise=True)[:, 0].astype(float)
        ones = np.ones(len(outline))
        self._blend(grey, outline, np.roll(outline, -1, axis=0), _FINGER * ones, ones)

    def _draw(self, grey: Array, mount: TagMount, X_W_body: Array) -> None:
        start, end, level, cover = _boundaries(mount.id, self._pieces)
        nodes = np.stack((start, end)) * (mount.size / 8)
        p_W = transform(np.asarray(X_W_body, float), transform(np.asarray(mount.pose, float), nodes))
        pixels = self.camera.project(point_in_world(p_W, mount.height))
        if not np.isfinite(pixels).all():
            return  # behind the camera
        self._blend(grey, pixels[0], pixels[1], level, cover)

    @staticmethod
    def _blend(grey: Array, start: Array, end: Array, level: Array, cover: Array) -> None:
        """Lay a shape over the picture whose level and cover rise by so much (n,) across segments (n, 2) [px]."""
        height, width = grey.shape
        pixels = np.stack((start, end))
        low = np.maximum(np.floor(pixels.min(axis=(0, 1)) + 0.5).astype(int), 0)
        high = np.minimum(np.floor(pixels.max(axis=(0, 1)) + 0.5).astype(int) + 1, (width, height))
        if (low < high).all():
            area_coverage.lay(grey, *pixels, *np.array((level, cover)), *low.tolist(), *high.tolist())


class SimTagCamera(Faulty[TagReading], TagCamera):
    """The tag camera of the simulated station, with the errors of the world's profile.

    It describes itself as it was calibrated, and takes its pictures as it is.

    In lockstep a frame is exposed only when `capture` asks for one; in real time the world asks at ``config.rate``.
    """

    def __init__(self, name: str, config: TagCameraConfig, world: TagWorld):
        super().__init__(name, buffer=256)
        self._config, self._world = config, world
        self._pinhole = config.model
        self._rng = np.random.default_rng(0)
        self._equip()
        self._detector: TagDetector | None = None
        self._image: ImageReading | None = None
        self._board: tuple[TagBoard, Array] | None = None
        self._sequence = 0

    def describe(self) -> Description:
        """Its rate is 0 (on request only) in lockstep."""
        return Description(
            name=self.name,
            kind="tag_camera",
            model="simulated pinhole camera",
            backend="sim",
            serial=self._config.serial,
            frame=self.name,
            rate=0.0 if self._world.lockstep else self._config.rate,
            range=(float(self._config.width), float(self._config.height)),
            resolution=(1.0,),
            extra={"camera": self.camera.as_dict(), "family": "tag36h11"},
        )

    def capture(self, timeout: float = 2.0) -> TagReading:
        """Expose a frame at this instant and report the tags found in it."""
        self._need_connection("capture")
        assert self._detector is not None
        figures = self._figures
        while figures.dropout and self._rng.random() < figures.dropout:
            self._sequence += 1  # a frame that never arrives; the next one is waited for
        picture, status = self.expose()
        now = self._world.now_ns()
        stamp = Stamp(now, now, self._sequence, self.name, status)
        self._sequence += 1
        self._image = ImageReading(stamp, picture, "mono8")
        reading = TagReading(stamp, self._found(self._detector, picture), self._detector.family)
        if figures.latency:
            reading = received(reading, now + round(figures.latency * 1e9))
        return self._hand_out(reading, timeout)

    def expose(self) -> tuple[NDArray[np.uint8], Status]:
        """A picture (h, w) of this instant, as it leaves the camera, and what it is worth; no tags are looked for."""
        figures = self._figures
        return self._developed(exposed(self._seen(), figures, self._rng), noisy=figures.noise > 0)

    def image(self) -> ImageReading | None:
        """The picture (mono8) behind the newest `capture`."""
        return self._image

    def show(self, board: TagBoard | None, X_W_B: Array) -> None:
        """Hold a board before the camera at ``X_W_B`` (4, 4) until told otherwise; None puts it away."""
        self._board = None if board is None else (board, X_W_B)

    def restart(self, rng: np.random.Generator | None = None) -> None:
        """Begin a new epoch after the world was reset, with ``rng``'s noise: frames count from 0, old ones are gone."""
        self._board = None
        self._rng = rng or self._rng
        self._equip()
        if self._detector is not None:
            self._shut()
            self._open(0.0)
        self._forget()
        self._sequence = 0
        self._image = None

    def begin_trial(self, rng: np.random.Generator) -> None:
        """Noise and losses from ``rng`` from now on, of the same camera, whatever it has seen before."""
        self._rng = rng
        if self._detector is not None:
            self._detector.forget()

    def _equip(self) -> None:
        """The camera that this lab has, by the profile and the epoch's random numbers."""
        self._figures = figures = self._world.profile.camera
        self.camera = calibrated(self._pinhole, figures)
        self._renderer = TagRenderer(actual(self.camera, figures, self._rng))

    def _seen(self) -> Array:
        """The picture while the shutter is open, in grey levels."""
        tags, screens, render = self._world.visible_tags(), self._world.screens(), self._renderer
        duration = self._figures.exposure_time
        moving = self._world.tag_twists() if duration else {}
        moving = {id: twist for id, twist in moving.items() if self._smear(twist) * duration > _SMEAR}
        if not moving:
            return render.paint(tags, screens, self._board)
        pictures = []
        for t in (np.arange(_POSES) + 0.5) / _POSES * duration - duration / 2:
            at = [(mount, X_W + t * moving[mount.id] if mount.id in moving else X_W) for mount, X_W in tags]
            pictures.append(render.paint(at, screens, self._board))
        return np.mean(pictures, axis=0)

    def _found(self, detector: TagDetector, picture: NDArray[np.uint8]) -> tuple[TagDetection, ...]:
        """The tags in the picture; the whole of it is searched where one is missing, or a board is shown."""
        if self._board is not None:
            return detector.detect(picture)
        return detector.track(picture, {mount.id for mount, _ in self._world.visible_tags()})

    def _smear(self, twist: Array) -> float:
        """Speed in the picture [px/s] of a tag at most 0.1 m from its body's origin."""
        speed = np.hypot(twist[0], twist[1]) + 0.1 * abs(twist[2])
        return float(
            speed * self._config.focal / np.linalg.norm(np.subtract(self._config.look_at, self._config.position))
        )

    def _open(self, timeout: float) -> None:
        self._detector = TagDetector(
            camera=self.camera if self.camera.distortion.any() else None, blur=0.8 if self._figures.noise else 0.0
        )

    def _shut(self) -> None:
        if self._detector is not None:
            self._detector.close()
            self._detector = None


@lru_cache(maxsize=64)
def _boundaries(id: int, pieces: int) -> tuple[Array, Array, Array, Array]:
    """Edges between cells that differ: start and end (n, 2) in cells from the tag's centre, y up.

    With each goes by how much the grey level and the cover rise from its left to its right when it points down the
    picture.
    """
    cells = tag_bitmap(id)
    n = len(cells)
    level = np.pad(np.where(cells > 127, _WHITE, _BLACK), 1)
    cover = np.pad(np.ones((n, n)), 1)
    start, end, jumps = [], [], []
    for row, column, down in ((r, c, d) for r in range(n + 1) for c in range(n + 1) for d in (True, False)):
        if down and row < n:
            right, left = (row + 1, column + 1), (row + 1, column)
            to = (row + 1, column)
        elif not down and column < n:
            right, left = (row, column + 1), (row + 1, column + 1)
            to = (row, column + 1)
        else:
            continue
        jump = (level[right] - level[left], cover[right] - cover[left])
        if any(jump):
            start.append((column - n / 2, n / 2 - row))
            end.append((to[1] - n / 2, n / 2 - to[0]))
            jumps.append(jump)
    first, last, rise = np.array(start), np.array(end), np.array(jumps)
    cuts = np.linspace(0, 1, pieces + 1)[:, None, None]
    nodes = first + cuts * (last - first)
    arrays = (nodes[:-1].reshape(-1, 2), nodes[1:].reshape(-1, 2), *np.tile(rise, (pieces, 1)).T)
    for array in arrays:
        array.setflags(write=False)
    return arrays
