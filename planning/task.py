"""What a skill asks of a planner, before any force is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mechanics.elasticity import check_positive_definite
from mechanics.friction import Mode
from mechanics.readings import Array


@dataclass(frozen=True, eq=False)
class ContactRequest:
    """A contact of the grasped object over the K steps of a task, and the force that is wanted there.

    ``p_goC`` (2,) [m] is its point in the go's frame, ``normal`` (K, 2) the unit normal into the go in W, ``modes``
    the mode at each step, ``mu`` the friction coefficient, ``force`` (K, 2) the desired (f_n, f_t) [N] on the go,
    ``by`` the body it touches. A (2,) normal or force and a single mode hold for every step. Signs as in
    `mechanics.friction`.
    """

    name: str
    p_goC: Array
    normal: Array
    modes: tuple[Mode, ...]
    mu: float
    force: Array
    by: str = "ground"

    def spread(self, steps: int) -> ContactRequest:
        """Return the same request with everything given per step. Raises ValueError where a length is not ``steps``."""
        place = f"contact '{self.name}'"
        normal = _array(f"{place}: normal", self.normal, (steps, 2))
        force = _array(f"{place}: force", self.force, (steps, 2))
        length = np.linalg.norm(normal, axis=-1)
        if np.abs(length - 1).max() > 1e-9:
            raise ValueError(
                f"{place}: normal: expected unit length, received {length[np.abs(length - 1).argmax()]:.9g}"
            )
        if not (np.isfinite(self.mu) and self.mu >= 0):
            raise ValueError(f"{place}: mu: expected a number ≥ 0, received {self.mu}")
        modes = (self.modes,) if isinstance(self.modes, str) else tuple(self.modes)
        modes = tuple(Mode(mode) for mode in (modes * steps if len(modes) == 1 else modes))
        if len(modes) != steps:
            raise ValueError(f"{place}: modes: expected {steps}, one per step, received {len(modes)}")
        point = _array(f"{place}: p_goC", self.p_goC, (2,))
        return ContactRequest(self.name, point, normal, modes, float(self.mu), force, self.by)


@dataclass(frozen=True, eq=False)
class Task:
    """K steps of the grasped object with the contacts that are to hold: what P2 needs to be posed.

    ``go`` (K, 3) are the poses X_W_go; ``X_go_gocf`` (3,) the grasp; ``mass`` [kg]; ``com`` (2,) [m] the centre of
    mass in the go's frame; ``gravity`` [m/s²] along −y of W; ``stiffness`` (3, 3) [N/m, N, N·m/rad] in gocf. Raises
    ValueError naming the field that does not fit.
    """

    skill: str
    go: Array
    contacts: tuple[ContactRequest, ...]
    X_go_gocf: Array
    mass: float
    stiffness: Array
    com: Array = (0.0, 0.0)  # type: ignore[assignment]
    gravity: float = 9.81

    def __post_init__(self) -> None:
        go = np.atleast_2d(np.asarray(self.go, dtype=np.float64))
        if go.ndim != 2 or go.shape[1] != 3 or len(go) == 0:
            raise ValueError(f"task '{self.skill}': go: expected shape (K, 3) with K ≥ 1, received {np.shape(self.go)}")
        fields = {
            "go": _array(f"task '{self.skill}': go", go, go.shape),
            "X_go_gocf": _array(f"task '{self.skill}': X_go_gocf", self.X_go_gocf, (3,)),
            "com": _array(f"task '{self.skill}': com", self.com, (2,)),
            "stiffness": _array(f"task '{self.skill}': stiffness", self.stiffness, (3, 3)),
            "contacts": tuple(contact.spread(len(go)) for contact in self.contacts),
        }
        for name, value in fields.items():
            object.__setattr__(self, name, value)
        for name in ("mass", "gravity"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ValueError(f"task '{self.skill}': {name}: expected a number ≥ 0, received {getattr(self, name)}")
        check_positive_definite(self.stiffness)
        names = [contact.name for contact in self.contacts]
        if len(set(names)) != len(names):
            raise ValueError(f"task '{self.skill}': contacts: expected distinct names, received {names}")

    @property
    def steps(self) -> int:
        """K."""
        return len(self.go)


def _array(place: str, value: object, shape: tuple[int, ...]) -> Array:
    """Return a read-only float64 copy of ``value``, repeated along the leading axis where that is what is missing."""
    array = np.array(value, dtype=np.float64)
    if array.shape == shape[1:]:
        array = np.broadcast_to(array, shape).copy()
    if array.shape != shape:
        raise ValueError(f"{place}: expected shape {shape}, received {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{place}: expected finite numbers, received {array[~np.isfinite(array)][0]}")
    array.setflags(write=False)
    return array
