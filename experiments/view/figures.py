"""What the planar scene is drawn of: outlines, frames, arrows, ellipses. All in metres, in the task plane."""

from __future__ import annotations

import numpy as np

from mechanics import se2
from mechanics.readings import Array

Colour = tuple[int, int, int]

NEWTON = 0.01
"""Length of a force's arrow [m/N]."""

SIGMAS = 2.0
"""How far ellipses and bands reach."""

FRAME = 0.015  # length of a frame's axes [m]
REACH = 0.09  # of a finger, from ee [m]
_PAD, _STEM = 0.02, 0.012  # a finger's pad and half its stem [m]: a drawing, not a model

SOURCES: dict[str, Colour] = {
    "planned": (140, 140, 140),
    "measured": (0, 150, 136),
    "estimated": (156, 64, 190),
    "truth": (38, 120, 210),
}
"""Whose word it is, with its colour: the plan's, the tags' and the wrist's, the controller's, the plant's."""

EXTRINSIC: Colour = (224, 132, 24)
"""The true extrinsic object's colour; elsewhere both objects have their source's."""

MODES: dict[str, Colour] = {"stick": (46, 160, 67), "slip+": (224, 132, 24), "slip-": (214, 58, 58)}
FREE: Colour = (150, 150, 150)
AXES: tuple[Colour, Colour] = ((214, 58, 58), (46, 160, 67))
GROUND: Colour = (120, 100, 80)


def closed(vertices: Array) -> Array:
    """The outline (N + 1, 2) of a polygon (N, 2)."""
    vertices = np.asarray(vertices, float)
    return np.concatenate([vertices, vertices[:1]])


def finger() -> Array:
    """The outline of a finger in ee, seen from the front."""
    rim = np.arctan2(_STEM, np.sqrt(_PAD**2 - _STEM**2))
    around = np.linspace(0.5 * np.pi + rim, 2.5 * np.pi - rim, 33)
    pad = _PAD * np.stack([np.cos(around), np.sin(around)], axis=-1)
    mount = [[_STEM, 0.05], [0.03, 0.064], [0.03, 0.086], [-0.03, 0.086], [-0.03, 0.064], [-_STEM, 0.05]]
    return closed(np.concatenate([pad, mount]))


def axes() -> tuple[Array, Array]:
    """x and y of a frame."""
    return np.array([[0.0, 0.0], [FRAME, 0.0]]), np.array([[0.0, 0.0], [0.0, FRAME]])


def ellipse(centre: Array, covariance: Array) -> Array:
    """The outline (49, 2) of the `SIGMAS` ellipse of a place (2,) with covariance (2, 2)."""
    values, vectors = np.linalg.eigh(0.5 * (covariance + covariance.T))
    around = np.linspace(0.0, 2.0 * np.pi, 49)
    circle = np.stack([np.cos(around), np.sin(around)])
    return centre + (SIGMAS * vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)).T


def position_covariance(ee: Array, go: Array, covariance: Array) -> Array:
    """Covariance (2, 2) in W of the go's origin, from that (3, 3) of a left perturbation of X_ee_go, in ee."""
    x, y = se2.between(ee, go)[:2]
    R = se2.rotation(ee[2])
    J = R @ np.array([[1.0, 0.0, -y], [0.0, 1.0, x]])  # a small turn about ee's origin moves p by θ ẑ × p
    return J @ covariance @ J.T
