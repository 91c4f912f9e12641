"""GelSlim fingers for `experiments.bench.tactile`: what they are opened as, what reads them, what they truly show."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from drivers.config import TactileConfig
from drivers.interfaces import TactileSensor
from drivers.sim.finger import FingerView
from drivers.sim.gel_optics import GelSlimOptics
from drivers.sim.gelslim import SimGelSlim
from estimation.tactile_pose import FingerModel, TactilePoseEstimator
from experiments.bench import tactile
from experiments.bench.tactile import Family, Grasp, Hand
from mechanics import se2
from mechanics.polygon import Polygon
from mechanics.readings import Array

#: places (x, y, θ) [m, m, rad] of the fingers in each object: a GelSlim sees 45 × 34 mm, so near ends and corners
GRASPS: dict[str, tuple[tuple[float, float, float], ...]] = {
    "tall_box": ((0.0, 0.063, 0.0), (0.012, 0.063, 0.3), (-0.012, -0.063, 1.3)),
    "triangle": ((0.0, 0.052, 0.0), (0.047, -0.026, 0.5)),
    "pentagon": ((0.0, 0.056, 0.0), (-0.052, 0.016, -0.4)),
    "heptagon": ((0.0, 0.060, 0.0), (0.058, -0.012, 0.8), (0.03, -0.053, -0.6)),
    "z": ((0.040, 0.050, 0.0), (-0.008, 0.052, 0.4), (-0.042, -0.046, -1.0)),
    "hbox": ((0.050, 0.020, 0.2), (-0.048, -0.021, 2.0)),
}


@dataclass
class GelHand(Hand):
    """A held object that has also been carried along since the grasp, by ``shear`` (3,): X of gocf in ee."""

    shear: Array = field(default_factory=lambda: np.zeros(3))

    def finger_view(self) -> FingerView:
        """The object as it was laid in."""
        return FingerView(self.outline, self.X_ee_go, self.shear, self.held)


def gelslim(width: int = 320, height: int = 240) -> Family:
    """GelSlims with pictures of this size."""

    def shown(grasp: Grasp) -> tuple[Array, Array]:
        """The boundary inside the picture, on the plane that the face presses to; both fingers see the same."""
        boundary = grasp.outline.boundary(0.5e-3)
        points = se2.transform(grasp.X_ee_go, boundary.points)
        camera = GelSlimOptics().camera(width, height)
        pixels = camera.project(np.column_stack((points, np.full(len(points), grasp.indentation))))
        inside = ((pixels > 0) & (pixels < (width - 1, height - 1))).all(axis=1)
        # far outside, the lens' polynomial folds back into the picture
        inside &= np.linalg.norm(points, axis=1) < 0.04
        return points[inside], se2.rotate(grasp.X_ee_go[2], boundary.normals[inside])

    def opened(hand: Hand, finger: str, indentation: float) -> TactileSensor:
        return open_gelslim(hand, finger, indentation, width, height)

    return Family(opened, methods, shown, (0.6e-3, 0.8e-3, 1.0e-3))


def open_gelslim(
    hand: Hand, finger: str, indentation: float = 0.8e-3, width: int = 320, height: int = 240
) -> SimGelSlim:
    """A connected simulated finger on ``hand``."""
    config = TactileConfig.model_validate(
        {"kind": "tactile", "sensor": "gelslim", "finger": finger, "indentation": indentation}
        | {"width": width, "height": height}
    )
    device = SimGelSlim(f"finger_{finger}", config, hand)
    device.connect()
    return device


def methods(model: FingerModel, outline: Polygon) -> Sequence[TactilePoseEstimator]:
    """The ways to read a gel's picture."""
    from estimation.gel_contact import GelContact
    from estimation.tactile_pose_gel import TactilePoseGel
    from estimation.tactile_pose_icp import CannyIcp

    return CannyIcp(model, outline, GelContact(model).read), TactilePoseGel(model, outline)


#: all families of the table, this one among them
FAMILIES: dict[str, Family] = {**tactile.FAMILIES, "gelslim": gelslim()}
