"""One description of a contact trajectory problem, for every form, loss, backend and optimiser.

A problem says how the extrinsic object (P1) or the environment (P2) lies at each of K steps, how the grasped object
touches it, in which modes, and what is wished for. What is left to choose are the variables z (K, 5), dimensionless:

    z · scale = (angle, travel, v1, v2, v3)

``angle`` [rad] is θ_go − θ_eo, ``travel`` [m] the arc length along the touched face; the contact closes by
construction:

    corner on face:  C = X_W_eo (p_eo + travel e),   p_go is the corner
    face on corner:  C = X_W_eo (p_eo),              C = X_W_go (p_go + travel e)

with e the face's outward normal turned by −90°. In the *closed form* v = (f_n, f_t) [N] is the force that the program
is asked for at the object contact (v3 is unused); the go's balance then gives the wrench of the sensor, and the
compliance the end-effector: X_W_ee = X_W_go ∘ X_go_gocf ∘ K⁻¹ w. In the *paper form* v = x, the end-effector's
displacement in gocf: w = K x, and what the go's balance lacks is a slack with a penalty, in the program and the loss.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from enum import StrEnum
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mechanics.elasticity import check_positive_definite
from mechanics.friction import Mode
from mechanics.polygon import Polygon
from mechanics.readings import Array

#: number of variables of a step
VARIABLES = 5
ANGLE, TRAVEL = 0, 1
#: a variable of 1 moves the go by this [m]
MILLIMETRE = 1e-3


class Form(StrEnum):
    """What the variables are; see the module."""

    CLOSED = "closed"
    PAPER = "paper"


class Touch(StrEnum):
    """Whose corner touches whose face, the grasped object's first."""

    CORNER_ON_FACE = "corner on face"
    FACE_ON_CORNER = "face on corner"


@dataclass(frozen=True, eq=False)
class Body:
    """A rigid polygon: ``vertices`` (V, 2) [m] in its frame, whose origin is its centre of mass; ``mass`` [kg]; ``rho``
    [m] its radius of gyration, by which angles are made lengths. Raises ValueError that names the field."""

    vertices: Array
    mass: float
    rho: float

    def __post_init__(self) -> None:
        outline = _array("body: vertices", self.vertices, (np.shape(self.vertices)[:1] or (0,))[0], 2)
        Polygon(outline)
        object.__setattr__(self, "vertices", outline)
        _number("body: mass", self.mass)
        _number("body: rho", self.rho, positive=True)


@dataclass(frozen=True, eq=False)
class ObjectContact:
    """Where the grasped object touches the other body (P1: the extrinsic object, P2: the environment).

    ``p_go`` and ``p_eo`` (2,) [m] meet at zero travel, each in its body's frame; ``normal`` (2,) is the touched face's
    outward unit normal in the frame of the body that owns it. ``modes`` (K); ``mu``; ``wish`` (K, 2) the force
    (f_n, f_t) [N] that is wished for, on the body acted on. Signs as in `mechanics.friction`. Raises ValueError.
    """

    name: str
    touch: Touch
    p_go: Array
    p_eo: Array
    normal: Array
    modes: tuple[Mode, ...]
    mu: float
    wish: Array

    def __post_init__(self) -> None:
        place = f"contact '{self.name}'"
        modes = _checked_contact(place, self)
        object.__setattr__(self, "touch", Touch(self.touch))
        object.__setattr__(self, "p_go", _array(f"{place}: p_go", self.p_go, 2))
        object.__setattr__(self, "normal", _array(f"{place}: normal", self.normal, 2))
        length = float(np.hypot(*self.normal))
        if abs(length - 1) > 1e-9:
            raise ValueError(f"{place}: normal: expected unit length, received {length:.9g}")
        object.__setattr__(self, "wish", _array(f"{place}: wish", self.wish, len(modes), 2, per_step=True))
        for k, mode in enumerate(modes):
            if mode is Mode.FREE and self.wish[k].any():
                wished = f"({self.wish[k, 0]:.3g}, {self.wish[k, 1]:.3g}) N"
                raise ValueError(f"{place}: wish: step {k} is free and carries no force: expected 0, received {wished}")


@dataclass(frozen=True, eq=False)
class GroundContact:
    """A point ``p_eo`` (2,) [m] of the extrinsic object on the ground (P1): ``modes`` (K) and ``mu``.

    Raises ValueError.
    """

    name: str
    p_eo: Array
    modes: tuple[Mode, ...]
    mu: float

    def __post_init__(self) -> None:
        _checked_contact(f"contact '{self.name}'", self)


@dataclass(frozen=True)
class LossWeights:
    """Weight of each loss; 0 leaves it out. Every loss is a sum of squared residuals, see `planning.losses`."""

    cone: float = 1.0
    pull: float = 100.0
    smooth: float = 0.01
    force: float = 1.0
    penetration: float = 0.01
    slack: float = 100.0
    track: float = 0.0
    workspace: float = 1.0
    joints: float = 1.0
    sensor: float = 1.0

    def __post_init__(self) -> None:
        for item in fields(self):
            _number(f"weights: {item.name}", getattr(self, item.name))


@dataclass(frozen=True, eq=False)
class PlanarArm:
    """The joints that move an arm in the task plane, as a chain of three: shoulder, elbow, wrist.

    ``base`` (2,) [m] is the shoulder in W; ``upper`` and ``fore`` [m] the lengths between the joints; ``tool`` (2,) [m]
    leads from the wrist to ee, in ee; ``elbow`` is +1 where it bends counter-clockwise, −1 else; ``zero`` (3,) [rad]
    the joints' readings where the chain lies along +x; ``limits`` (3, 2) [rad]. Raises ValueError.
    """

    base: Array
    upper: float
    fore: float
    tool: Array
    elbow: int
    zero: Array
    limits: Array

    def __post_init__(self) -> None:
        for name, shape in (("base", (2,)), ("tool", (2,)), ("zero", (3,)), ("limits", (3, 2))):
            object.__setattr__(self, name, _array(f"arm: {name}", getattr(self, name), *shape))
        _number("arm: upper", self.upper, positive=True)
        _number("arm: fore", self.fore, positive=True)
        if self.elbow not in (-1, 1):
            raise ValueError(f"arm: elbow: expected 1 or -1, received {self.elbow}")
        _ordered("arm: limits", self.limits, ("shoulder", "elbow", "wrist"))


@dataclass(frozen=True, eq=False)
class Limits:
    """What the plan must stay within, by barriers: ``workspace`` (3, 2) least and largest X_W_ee [m, m, rad]; ``arm``
    with its joints' limits; ``force`` [N] and ``torque`` [N·m] that the sensor takes. None where there is no limit."""

    workspace: Array | None = None
    arm: PlanarArm | None = None
    force: float | None = None
    torque: float | None = None

    def __post_init__(self) -> None:
        if self.workspace is not None:
            object.__setattr__(self, "workspace", _array("limits: workspace", self.workspace, 3, 2))
            _ordered("limits: workspace", self.workspace, ("x", "y", "angle"))
        for name in ("force", "torque"):
            if getattr(self, name) is not None:
                _number(f"limits: {name}", getattr(self, name), positive=True)


@dataclass(frozen=True, eq=False)
class Problem:
    """K steps. ``eo`` (K, 3) X_W_eo (P2: where the environment's frame is, as a rule zero); ``eo_body`` None for P2.

    ``contacts`` are those of the go: the first closes the geometry; a second (P2, face on ground) lies on the same
    face. ``ground`` are those of the eo with the ground. ``angle`` and ``travel`` (K,) are nominal values: the start,
    and what is tracked. ``free`` (K, 5) says what may change. ``angle_limits`` (K, 2) [rad] is what does not penetrate.
    ``force_weight`` is U = force_weight · I of the object's contacts in the closed form, 1 at the ground and in the
    paper form: there v asks for a force, and the ground should not talk it down. ``slack_weight`` is the penalty in the
    paper form's program, of (s_x, s_y, s_τ/ρ_go): what the balance lacks is about the force over it.

    Arrays are kept read-only; ``free`` is False for v3 in the closed form, which has no use for it. Raises ValueError
    that names field and step: shapes, numbers that are none, a contact off its face or coincident with another, modes
    that contradict each other or the nominal motion (`planning.consistency`).
    """

    skill: str
    form: Form
    eo: Array
    eo_body: Body | None
    go_body: Body
    grasp: Array
    stiffness: Array
    contacts: tuple[ObjectContact, ...]
    ground: tuple[GroundContact, ...]
    angle: Array
    travel: Array
    free: NDArray[np.bool_]
    angle_limits: Array
    weights: LossWeights = field(default_factory=LossWeights)
    limits: Limits = field(default_factory=Limits)
    force_weight: float = 100.0
    slack_weight: float = 1e4
    gravity: float = 9.81

    def __post_init__(self) -> None:
        from planning.consistency import check

        place = f"problem '{self.skill}'"
        object.__setattr__(self, "form", Form(self.form))
        object.__setattr__(self, "contacts", tuple(self.contacts))
        object.__setattr__(self, "ground", tuple(self.ground))
        K = len(self.eo) if np.ndim(self.eo) else 0
        if K < 1:
            raise ValueError(f"{place}: eo: expected shape (K, 3) with K ≥ 1, received {np.shape(self.eo)}")
        for name, shape in (("grasp", (3,)), ("stiffness", (3, 3))):
            object.__setattr__(self, name, _array(f"{place}: {name}", getattr(self, name), *shape))
        for name, shape in (("eo", (K, 3)), ("angle", (K,)), ("travel", (K,)), ("angle_limits", (K, 2))):
            object.__setattr__(self, name, _array(f"{place}: {name}", getattr(self, name), *shape, per_step=True))
        free = np.array(self.free)
        if free.shape != (K, VARIABLES) or free.dtype != np.bool_:
            raise ValueError(
                f"{place}: free: expected booleans of shape {(K, VARIABLES)}, received {free.dtype} of {free.shape}"
            )
        if self.form is Form.CLOSED:
            free[:, VARIABLES - 1] = False
        free.setflags(write=False)
        object.__setattr__(self, "free", free)
        check_positive_definite(self.stiffness)
        _number(f"{place}: force_weight", self.force_weight, positive=True)
        _number(f"{place}: slack_weight", self.slack_weight, positive=True)
        _number(f"{place}: gravity", self.gravity)
        check(self)

    @property
    def steps(self) -> int:
        """K."""
        return len(self.eo)

    @cached_property
    def scale(self) -> Array:
        """(5,) what a variable of 1 stands for: 1 mm of the go's motion, or 1 N. SI."""
        turn = MILLIMETRE / self.go_body.rho
        v = (1.0, 1.0, 1.0) if self.form is Form.CLOSED else (MILLIMETRE, MILLIMETRE, turn)
        return np.array([turn, MILLIMETRE, *v])

    @cached_property
    def start(self) -> Array:
        """z (K, 5) at the nominal values: v is the wished force; in the paper form, what balances the go under it."""
        from planning.closure import nominal_start

        return nominal_start(self)


def _checked_contact(place: str, contact: ObjectContact | GroundContact) -> tuple[Mode, ...]:
    """Check and set what both kinds have; return the modes."""
    if not contact.name:
        raise ValueError("contact: name: expected one, received none")
    object.__setattr__(contact, "p_eo", _array(f"{place}: p_eo", contact.p_eo, 2))
    modes: list[Mode] = []
    for k, mode in enumerate(contact.modes):
        try:
            modes.append(Mode(mode))
        except ValueError:
            known = ", ".join(Mode)
            raise ValueError(f"{place}: modes: step {k}: expected one of {known}, received {mode!r}") from None
    object.__setattr__(contact, "modes", tuple(modes))
    _number(f"{place}: mu", contact.mu)
    return tuple(modes)


def _array(place: str, value: Any, *shape: int, per_step: bool = False) -> Array:
    """Return a read-only float64 copy of ``value``. Raises ValueError for another shape or numbers that are none."""
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{place}: expected numbers of shape {shape}, received {value!r}") from None
    if array.shape != shape:
        raise ValueError(f"{place}: expected shape {shape}, received {array.shape}")
    if not np.isfinite(array).all():
        at = np.argwhere(~np.isfinite(array))[0]
        step = f"step {at[0]}: " if per_step else ""
        raise ValueError(f"{place}: {step}expected finite numbers, received {array[tuple(at)]}")
    array.setflags(write=False)
    return array


def _number(place: str, value: float, positive: bool = False) -> None:
    """Raise ValueError unless ``value`` is a finite number ≥ 0, or > 0."""
    if not (np.isfinite(value) and (value > 0 if positive else value >= 0)):
        raise ValueError(f"{place}: expected a number {'> 0' if positive else '≥ 0'}, received {value}")


def _ordered(place: str, limits: Array, names: tuple[str, ...]) -> None:
    """Raise ValueError unless each row is (least, largest)."""
    for name, (lo, hi) in zip(names, limits, strict=True):
        if not lo < hi:
            raise ValueError(f"{place}: {name}: expected the least before the largest, received {lo:.6g}, {hi:.6g}")
