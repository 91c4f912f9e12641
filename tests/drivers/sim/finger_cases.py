"""Faces, how they lie between the fingers, and a world in which a GelSlim feels them."""

import numpy as np

from drivers.config import TactileConfig
from drivers.sim.finger import FingerView
from drivers.sim.gel_noise import GelNoise
from drivers.sim.gelslim import SimGelSlim
from drivers.sim.mismatch import Mismatch

BOX = np.array([(-0.008, -0.05), (0.008, -0.05), (0.008, 0.010), (-0.008, 0.010)])
BOARD = np.array([(-0.05, -0.05), (0.05, -0.05), (0.05, 0.05), (-0.05, 0.05)])
HEXAGON = 0.008 * np.array([(np.cos(a), np.sin(a)) for a in np.arange(6) * np.pi / 3])
NOWHERE = np.array([10.0, 0.0, 0.0])


def pose(x_mm: float = 0, y_mm: float = 0, degrees: float = 0) -> np.ndarray:
    return np.array([x_mm / 1e3, y_mm / 1e3, np.deg2rad(degrees)])


def view(outline: np.ndarray = BOX, rest: np.ndarray = NOWHERE, shear: np.ndarray | None = None, held: bool = True):
    """The object lay at ``rest`` in the ee when it was grasped and has moved by ``shear`` (about the ee) since."""
    shear = pose() if shear is None else shear
    z = np.exp(1j * shear[2]) * complex(*rest[:2]) + complex(*shear[:2])
    return FingerView(outline, np.array([z.real, z.imag, rest[2] + shear[2]]), shear, held)


class FakeWorld:
    """A clock, a profile and what the fingers feel."""

    lockstep = True

    def __init__(self, felt: FingerView | None = None, noise: GelNoise | None = None):
        self.felt = view() if felt is None else felt
        self.profile = Mismatch(gel=noise or GelNoise())
        self.time = 3

    def now_ns(self) -> int:
        return self.time

    def finger_view(self) -> FingerView:
        return self.felt


def config(finger: str = "left", width: int = 320, height: int = 240, indentation: float = 0.0008) -> TactileConfig:
    return TactileConfig.model_validate(
        {"kind": "tactile", "sensor": "gelslim", "finger": finger, "width": width, "height": height}
        | {"indentation": indentation}
    )


def opened(world: FakeWorld, finger: str = "left", width: int = 320, height: int = 240) -> SimGelSlim:
    sensor = SimGelSlim("finger", config(finger, width, height), world)
    sensor.connect()
    return sensor
