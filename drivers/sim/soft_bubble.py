"""A simulated Soft Bubble finger: depth images of an inflated membrane, pressed by the held object's face."""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from drivers.config import TactileConfig
from drivers.errors import DeviceFault, DeviceTimeout
from drivers.interfaces import Description, TactileSensor
from drivers.sim.bubble_geometry import DEPTH_UNIT, DOME, camera_of
from drivers.sim.bubble_noise import BubbleNoise, DepthNoise, NoiseSource
from drivers.sim.faults import Faulty
from drivers.sim.finger import X_EE_FINGER, FingerView
from mechanics import se2
from mechanics.readings import Array, ImageReading, Stamp, Status

if TYPE_CHECKING:
    from drivers.sim.bubble_optics import BubbleView

_loading = threading.Lock()


class _Profile(Protocol):
    @property
    def bubble(self) -> BubbleNoise: ...


class BubbleWorld(Protocol):
    """What a Soft Bubble needs of the simulated world."""

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


def view_of(config: TactileConfig) -> BubbleView:
    """The membrane and the camera behind a finger, ready to render.

    Loads compiled code (half a second); compiles it first where this installation has not done so yet (some ten
    seconds). Several threads may ask.
    """
    with _loading:
        from drivers.sim.bubble_optics import BubbleView, quantised

        view = BubbleView(camera_of(config.width, config.height))
        small = 0.01 * np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
        quantised(view.depth(small, config.indentation).astype(np.float32))
        view.depth(None, config.indentation)
        return view


class SimSoftBubble(Faulty[ImageReading], TactileSensor):
    """One Soft Bubble of the simulated station; its readings are 16UC1 depth in tenths of a millimetre, 0: none.

    The finger's frame F has its origin at the apex of the unpressed dome, on the line of the grasp centre; x and y are
    as one sees the object from the finger, upright, and z points into the finger, to the camera. The right finger sees
    the object from behind: its x is −x of the ee. The camera's x is y of F, along the dome's long axis, and its y is x
    of F. A reading's status is NO_CONTACT when nothing is held.

    In lockstep a frame is rendered only when `capture` asks for one; in real time the world asks at ``config.rate``.
    While the device is opened, a thread of its own loads the compiled renderer; `capture` waits for it.
    """

    def __init__(self, name: str, config: TactileConfig, world: BubbleWorld):
        super().__init__(name, buffer=64)
        if config.indentation >= DOME.top:
            raise ValueError(
                f"devices.{name}.indentation: {config.indentation * 1e3:g} mm is deeper than a Soft Bubble's dome is "
                f"high; expected less than {DOME.top * 1e3:g} mm, usually 12"
            )
        self._config, self._world = config, world
        self.camera = camera_of(config.width, config.height)
        self._view: BubbleView | None = None
        self._loader: threading.Thread | None = None
        self._trouble: Exception | None = None
        self._rng = np.random.default_rng(0)
        self._noise: tuple[DepthNoise, NoiseSource] | None = None
        self._sequence = self._began_ns = 0

    def describe(self) -> Description:
        """``range`` and ``resolution`` are depths [m]; the rate is 0 (on request only) in lockstep.

        ``extra``: ``camera`` is its CameraModel, whose world is the finger's frame, ``X_ee_finger`` (4, 4) that frame
        in the ee; its place along the ee's Y is the gripper's and left at zero. ``dome`` has the unpressed membrane's
        semi-axes along the camera's x and y, its height and the apex's depth.
        """
        config, camera = self._config, self.camera
        return Description(
            name=self.name,
            kind="tactile",
            model=f"simulated Soft Bubble with {camera.model}",
            backend="sim",
            serial=config.serial,
            frame=self.name,
            rate=0.0 if self._world.lockstep else config.rate,
            range=(round(camera.distance - DOME.top, 9), camera.distance),
            resolution=(DEPTH_UNIT,),
            extra={
                "sensor": "soft_bubble",
                "finger": config.finger,
                "encoding": "16UC1",
                "width": config.width,
                "height": config.height,
                "depth_unit": DEPTH_UNIT,
                "indentation_mm": 1e3 * config.indentation,
                "camera": camera.model_in_finger().as_dict(),
                "X_ee_finger": [list(row) for row in X_EE_FINGER[config.finger]],
                "dome": {"a": DOME.a, "b": DOME.b, "height": DOME.top, "apex_depth": camera.distance},
                "reference": True,
            },
        )

    def capture(self, timeout: float = 2.0) -> ImageReading:
        """A frame of this instant. Raises NotConnected, DeviceTimeout, and DeviceFault while there is no scene."""
        self._need_connection("capture")
        view = self._world.finger_view()
        bubble = self._ready("capture", timeout)
        outline = _outline_in_finger(view, self._config.finger) if view.held else None
        # the camera's x is the finger's y and its y the finger's x
        depth = bubble.depth(None if outline is None else outline[:, ::-1], self._config.indentation)
        now, source = self._world.now_ns(), self._spoiler()
        at = (now - self._began_ns) * 1e-9  # of this epoch: the noise is to the last bit the same at every time of day
        picture, status = self._developed(self._quantised(source.spoil(depth, at)), noisy=source.noisy)
        if status is Status.OK and not view.held:
            status = Status.NO_CONTACT
        stamp = Stamp(now, now, self._sequence, self.name, status)
        self._sequence += 1
        return self._hand_out(ImageReading(stamp, picture, "16UC1"), timeout)

    def reference(self) -> NDArray[np.uint16]:
        """The unpressed dome (h, w), as the mean of many frames: with what is constant in the camera's noise."""
        self._need_connection("take the reference image")
        bubble = self._ready("take the reference image", 2.0)
        return self._quantised(self._spoiler().spoil(bubble.reference, None))

    def restart(self, rng: np.random.Generator | None = None) -> None:
        """Begin a new epoch after the world was reset, with ``rng``'s noise: frames count from 0, old ones are gone."""
        self._rng = rng or self._rng
        self._noise = None
        if self._view is not None:
            self._view.depth(None, self._config.indentation)  # so that no frame depends on the epoch before
        self._forget()
        self._sequence, self._began_ns = 0, self._world.now_ns()

    def begin_trial(self, rng: np.random.Generator) -> None:
        """Noise from ``rng`` from now on, of the same camera."""
        self._spoiler().begin_trial(rng)

    def _figures(self) -> DepthNoise:
        bubble = self._world.profile.bubble
        return bubble.stereo if self.camera.kind == "stereo" else bubble.time_of_flight

    def _spoiler(self) -> NoiseSource:
        figures = self._figures()
        if self._noise is None or self._noise[0] != figures:
            config = self._config
            source = NoiseSource(figures, (config.height, config.width), self._rng, 1 / config.rate)
            self._noise = figures, source
        return self._noise[1]

    @staticmethod
    def _quantised(depth: NDArray) -> NDArray[np.uint16]:
        from drivers.sim.bubble_optics import quantised

        return quantised(depth)

    # -- the renderer ------------------------------------------------------------------------------------------------

    def _load(self) -> None:
        try:
            self._view = view_of(self._config)
        except Exception as problem:
            self._trouble = problem

    def _ready(self, asked: str, timeout: float) -> BubbleView:
        loader = self._loader
        if self._view is None and loader is not None:
            loader.join(timeout)
            if loader.is_alive():
                raise DeviceTimeout(
                    self.name,
                    asked,
                    f"its renderer is still being compiled after {timeout:g} s",
                    "Ask again: this happens once after an installation and takes some ten seconds",
                )
        if self._view is None:
            raise DeviceFault(self.name, asked, f"no renderer: {self._trouble}", "This is a defect; report it")
        return self._view

    def _open(self, timeout: float) -> None:
        self._forget()
        if self._view is None:
            self._trouble = None
            self._loader = threading.Thread(target=self._load, name=f"{self.name} renderer", daemon=True)
            self._loader.start()

    def _shut(self) -> None:
        loader, self._loader = self._loader, None
        if loader is not None:
            loader.join(timeout=0.5)  # a compiler cannot be interrupted


def _outline_in_finger(view: FingerView, finger: str) -> Array:
    """The held object's outline (N, 2) [m] in the finger's x and y."""
    outline = se2.transform(view.X_ee_go, view.outline)
    return outline * (-1.0, 1.0) if finger == "right" else outline
