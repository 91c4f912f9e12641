"""What a simulated tactile finger feels: the held object's face, where it is and how it has moved since the grasp."""

from __future__ import annotations

from dataclasses import dataclass

from drivers.finger_frames import X_EE_FINGER
from mechanics.readings import Array

__all__ = ["X_EE_FINGER", "FingerView"]


@dataclass(frozen=True, slots=True)
class FingerView:
    """The held object as the fingers feel it, in the end-effector's frame (its origin is the fingers' centre).

    ``outline`` (N, 2) [m] is the object's polygon in its own frame, ``X_ee_go`` (3,) its pose, ``X_ee_gocf`` (3,) the
    pose of the grasp frame: (0, 0, 0) at zero wrench, so it is the shear of the membrane or gel. ``held``: whether
    the fingers are closed on it.
    """

    outline: Array
    X_ee_go: Array
    X_ee_gocf: Array
    held: bool
