"""A simulated GelSlim finger: colour pictures of a gel with marker dots, pressed by the held object's face."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.config import TactileConfig
from drivers.interfaces import Description, TactileSensor
from drivers.sim.faults import Faulty
from drivers.sim.finger import X_EE_FINGER, FingerView
from drivers.sim.gel import GelPad, PressedGel
from drivers.sim.gel_noise import GelNoise, NoisyExposure, rounded
from drivers.sim.gel_optics import GelRenderer, GelSlimOptics, renderer
from mechanics.readings import Array, ImageReading, Stamp, Status


class _Profile(Protocol):
    @property
    def gel(self) -> GelNoise: ...


class GelWorld(Protocol):
    """What a GelSlim needs of the simulated world."""

    lockstep: bool

    @property
    def profile(self) -> _Profile:
        """The mismatch profile."""
        ...

    def now_ns(self) -> int:
        """Present instant [ns]."""
        ...

    def finger_view(self) -> FingerView:
        """What the fingers feel of the held object at this instant."""
        ...


class SimGelSlim(Faulty[ImageReading], TactileSensor):
    """One GelSlim finger of the simulated station; its readings are bgr8.

    The finger's frame F has its origin in the middle of the gel's undeformed surface, which is the grasp centre; x is
    right and y up in the picture, z points from the gel to the camera. The right finger sees the object from behind:
    its x is −x of the ee. A reading's status is NO_CONTACT when nothing is held.

    In lockstep a frame is exposed only when `capture` asks for one; in real time the world asks at ``config.rate``.
    """

    def __init__(self, name: str, config: TactileConfig, world: GelWorld):
        super().__init__(name, buffer=64)
        self.pad, self.optics = GelPad(), GelSlimOptics()
        if config.indentation > self.pad.deepest:
            raise ValueError(
                f"devices.{name}.indentation: {config.indentation * 1e3:g} mm is deeper than a GelSlim's gel goes; "
                f"expected at most {self.pad.deepest * 1e3:g} mm, usually 0.8"
            )
        self._config, self._world = config, world
        self._renderer: GelRenderer | None = None
        self._rng = np.random.default_rng(0)
        self._exposure: tuple[GelNoise, NoisyExposure] | None = None
        self._sequence = 0

    def describe(self) -> Description:
        """``extra`` has the camera, its world being the finger's frame, that frame in the ee, and where markers are.

        ``mm_per_px`` is in the middle of the picture at rest; ``markers_mm`` are the markers' places in the finger's
        frame at rest, row by row. The rate is 0 (on request only) in lockstep.
        """
        config, optics = self._config, self.optics
        camera = optics.camera(config.width, config.height)
        return Description(
            name=self.name,
            kind="tactile",
            model="simulated GelSlim 3.0",
            backend="sim",
            serial=config.serial,
            frame=self.name,
            rate=0.0 if self._world.lockstep else config.rate,
            range=(0.0, 255.0),
            resolution=(1.0,),
            extra={
                "sensor": "gelslim",
                "finger": config.finger,
                "encoding": "bgr8",
                "width": config.width,
                "height": config.height,
                "mm_per_px": 1e3 * optics.distance / float(camera.K[0, 0]),
                "indentation_mm": 1e3 * config.indentation,
                "camera": camera.as_dict(),
                "X_ee_finger": [list(row) for row in X_EE_FINGER[config.finger]],
                "marker_pitch_mm": 1e3 * optics.pitch,
                "reference": True,
                "markers_mm": (1e3 * optics.markers(config.width, config.height)).round(6).tolist(),
            },
        )

    def capture(self, timeout: float = 2.0) -> ImageReading:
        """Expose a frame at this instant. Raises NotConnected, and DeviceFault while the world has no scene."""
        self._need_connection("capture")
        view = self._world.finger_view()
        image, status = self._developed(self._noise().expose(self._picture(view)), self._world.profile.gel.noise > 0)
        now = self._world.now_ns()
        if status is Status.OK and not view.held:
            status = Status.NO_CONTACT
        reading = ImageReading(Stamp(now, now, self._sequence, self.name, status), image, "bgr8")
        self._sequence += 1
        return self._hand_out(reading, timeout)

    def reference(self) -> NDArray[np.uint8]:
        """The untouched gel (h, w, 3) bgr8, as the mean of many frames: with the camera's constant errors, no noise."""
        self._need_connection("take the reference picture")
        return rounded(self._noise().constant(self._picture(None)))

    def restart(self, rng: np.random.Generator | None = None) -> None:
        """Begin a new epoch after the world was reset, with ``rng``'s noise: frames count from 0, old ones are gone."""
        self._rng = rng or self._rng
        self._exposure = None
        self._forget()
        self._sequence = 0

    def begin_trial(self, rng: np.random.Generator) -> None:
        """Noise from ``rng`` from now on, of the same camera."""
        self._noise().begin_trial(rng)

    def _picture(self, view: FingerView | None) -> NDArray[np.float32]:
        assert self._renderer is not None
        if view is None or not view.held:
            return self._renderer.render(None)
        if self._config.finger == "right":
            view = mirrored(view)
        gel = PressedGel(self.pad, view.outline, view.X_ee_go, view.X_ee_gocf, self._config.indentation)
        return self._renderer.render(gel)

    def _noise(self) -> NoisyExposure:
        figures = self._world.profile.gel
        if self._exposure is None or self._exposure[0] != figures:
            config = self._config
            self._exposure = figures, NoisyExposure(figures, config.width, config.height, self._rng)
        return self._exposure[1]

    def _open(self, timeout: float) -> None:
        if self._renderer is None:
            self._renderer = renderer(self.optics, self._config.width, self._config.height)

    def _shut(self) -> None:
        pass


def mirrored(view: FingerView) -> FingerView:
    """The same as seen from behind: x points the other way."""
    flip = np.array([-1.0, 1.0])
    outline: Array = (view.outline * flip)[::-1]
    return FingerView(outline, _flipped(view.X_ee_go), _flipped(view.X_ee_gocf), view.held)


def _flipped(pose: Array) -> Array:
    return np.asarray(pose, float) * np.array([-1.0, 1.0, -1.0])
