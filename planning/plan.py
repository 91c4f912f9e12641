"""A plan: where everything is and which forces act, at each step, with the ramps before and after."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, Self

import numpy as np

from mechanics import se2, wrench
from mechanics.contact import gravity_wrench
from mechanics.elasticity import Elasticity, check_positive_definite
from mechanics.friction import Mode
from mechanics.readings import Array

SCHEMA = 2

_POSES = ("ee", "go", "eo", *(f"{part}_{body}" for part in ("preload", "unload") for body in ("ee", "go", "eo")))
_WRENCHES = ("wrench", "preload_wrench", "unload_wrench")
_FIGURES, _TEXTS = ("mass", "gravity", "loss", "queries", "time_s"), ("name", "skill", "planner", "status")
_SHAPES = {
    "X_go_gocf": (3,),
    "stiffness": (3, 3),
    "com": (2,),
    **dict.fromkeys(("ee", "go", "eo", "wrench"), ("K", 3)),
    **dict.fromkeys(("contact_points", "contact_normals", "contact_forces"), ("K", "C", 2)),
    "contact_mu": ("C",),
    **dict.fromkeys(("preload_ee", "preload_go", "preload_eo", "preload_wrench"), ("M", 3)),
    **dict.fromkeys(("unload_ee", "unload_go", "unload_eo", "unload_wrench"), ("N", 3)),
}


@dataclass(frozen=True, eq=False, kw_only=True)
class Plan:
    """K steps, C contacts, in the frame W that the plan was made in (or moved to, see `reanchored`).

    Poses (K, 3) are X_W_ee, X_W_go and X_W_eo (None without an extrinsic object). ``wrench`` (K, 3) [N, N, N·m] is of
    the sensor on the go about the grasp centre, axes of W. Contacts: ``contact_points`` and unit
    ``contact_normals`` (K, C, 2) in W, ``contact_forces`` (K, C, 2) as (f_n, f_t) [N], ``contact_modes`` K × C,
    ``contact_mu`` (C,), ``contact_names`` C; signs as in `mechanics.friction`. ``contact_bodies`` C pairs (on, by) of
    ``go``, ``eo`` and ``ground``: which body the contact acts on, and which one it is touched by.

    ``preload_*`` (M, 3): the go's force grows from none to the first step's at poses that stay, both ends included;
    ``unload_*`` (N, 3): it falls to none. A pivoted object is first turned back, over all steps from the last to the
    first. ``supported``: something else has to hold the extrinsic object during both. ``mass`` [kg], ``com`` (2,) [m]
    in the go's frame and ``gravity`` [m/s²] along −y are what the wrenches carry; ``stiffness`` (3, 3) is the finger's
    in gocf. ``planner`` is the optimiser, ``loss`` what it reached, ``queries`` how many trajectories it asked for in
    ``time_s`` seconds. ``status`` is ``solved``, or ``inaccurate`` where the result misses what was asked for.
    ``provenance`` is what JSON can hold: how the plan came about. Arrays are read-only.
    """

    name: str
    skill: str
    planner: str
    X_go_gocf: Array
    stiffness: Array
    mass: float
    com: Array
    gravity: float
    ee: Array
    go: Array
    eo: Array | None
    wrench: Array
    contact_names: tuple[str, ...]
    contact_points: Array
    contact_normals: Array
    contact_forces: Array
    contact_modes: tuple[tuple[Mode, ...], ...]
    contact_mu: Array
    preload_ee: Array
    preload_go: Array
    preload_wrench: Array
    unload_ee: Array
    unload_go: Array
    unload_wrench: Array
    status: str = "solved"
    loss: float = 0.0
    queries: int = 0
    time_s: float = 0.0
    preload_eo: Array | None = None
    unload_eo: Array | None = None
    contact_bodies: tuple[tuple[str, str], ...] | None = None
    supported: bool = False
    provenance: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        sizes: dict[str, int] = {"C": len(self.contact_names)}
        object.__setattr__(self, "contact_names", tuple(self.contact_names))
        for name, shape in _SHAPES.items():
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, _checked(self.name, name, value, shape, sizes))
        modes = tuple(tuple(Mode(mode) for mode in row) for row in self.contact_modes)
        if len(modes) != sizes["K"] or any(len(row) != sizes["C"] for row in modes):
            raise ValueError(
                f"plan '{self.name}': contact_modes: expected {sizes['K']} rows of {sizes['C']} modes,"
                f" received {len(modes)} rows of {sorted({len(row) for row in modes})}"
            )
        object.__setattr__(self, "contact_modes", modes)
        bodies = (("go", "ground"),) * sizes["C"] if self.contact_bodies is None else self.contact_bodies
        object.__setattr__(self, "contact_bodies", tuple((str(on), str(by)) for on, by in bodies))
        if len(bodies) != sizes["C"]:
            raise ValueError(f"plan '{self.name}': contact_bodies: expected {sizes['C']}, received {len(bodies)}")
        try:
            object.__setattr__(self, "provenance", json.loads(json.dumps(self.provenance, allow_nan=False)))
        except (TypeError, ValueError) as error:
            raise ValueError(f"plan '{self.name}': provenance: expected what JSON can hold: {error}") from None

    @property
    def steps(self) -> int:
        """K."""
        return len(self.ee)

    def free_air_ee(self, X_W_go: Array) -> Array:
        """Return X_W_ee (..., 3) that holds the go at ``X_W_go`` (..., 3) in free air, carrying only its weight."""
        arm = se2.rotate(np.asarray(X_W_go)[..., 2], self.com - self.X_go_gocf[:2])
        carried = -gravity_wrench(self.mass, arm, self.gravity)
        return Elasticity(self.stiffness).ee_pose(X_W_go, self.X_go_gocf, carried)

    def with_stiffness(self, stiffness: Array) -> Self:
        """Return the plan for a finger of ``stiffness`` (3, 3) [N/m, N, N·m/rad] in gocf.

        The go's poses and every force stay; the end-effector follows from them, ee = go ⊕ X_go_gocf ⊕ K⁻¹ w, on the
        ramps too. Raises ValueError unless K is symmetric positive definite.
        """
        finger = Elasticity(np.asarray(stiffness, dtype=np.float64))
        moved = {
            f"{part}ee": finger.ee_pose(getattr(self, f"{part}go"), self.X_go_gocf, getattr(self, f"{part}wrench"))
            for part in ("", "preload_", "unload_")
        }
        return replace(self, stiffness=finger.stiffness, **moved)

    def reanchored(self, X_W_table: Array) -> Self:
        """Return the plan for a table whose frame sits at ``X_W_table`` (3,) where this plan's table sits at identity.

        Poses, points, normals and wrenches move with the table; (f_n, f_t) stay. Gravity stays along −y of W: a table
        that leans carries the plan's forces with it, not the weight's direction.
        """
        X_W_table = np.asarray(X_W_table, dtype=np.float64)
        moved: dict[str, Any] = {
            name: se2.compose(X_W_table, getattr(self, name)) for name in _POSES if getattr(self, name) is not None
        }
        moved |= {name: wrench.rotated(getattr(self, name), X_W_table[2]) for name in _WRENCHES}
        moved["contact_points"] = se2.transform(X_W_table, self.contact_points)
        moved["contact_normals"] = se2.rotate(X_W_table[2], self.contact_normals)
        return replace(self, **moved)

    def to_dict(self) -> dict[str, Any]:
        """Return what JSON can hold; `from_dict` gives back the same plan, to the last bit."""
        plain: dict[str, Any] = {"schema": SCHEMA}
        for item in fields(self):
            value = getattr(self, item.name)
            plain[item.name] = value.tolist() if isinstance(value, np.ndarray) else value
        plain["contact_names"] = list(self.contact_names)
        plain["contact_bodies"] = [list(pair) for pair in self.contact_bodies or ()]
        plain["contact_modes"] = [[mode.value for mode in row] for row in self.contact_modes]
        return plain

    @classmethod
    def from_dict(cls, plain: Mapping[str, Any]) -> Self:
        """Return the plan of `to_dict`.

        Raises ValueError on another schema, on keys missing or not known, and on values that are no plan's.
        """
        if not isinstance(plain, Mapping):
            raise ValueError(f"plan: expected a mapping, received {type(plain).__name__}")
        schema = plain.get("schema")
        if schema != SCHEMA:
            raise ValueError(f"plan: schema: expected {SCHEMA}, received {schema!r}: plan again with this version")
        expected, received = {item.name for item in fields(cls)}, set(plain) - {"schema"}
        if expected != received:
            wrong = [f"missing {sorted(expected - received)}"] * (not expected <= received)
            wrong += [f"not known {sorted(received - expected)}"] * (not received <= expected)
            raise ValueError(f"plan: keys: {'; '.join(wrong)}")
        for names, kind in ((_FIGURES, int | float), (_TEXTS, str), (("supported",), bool), (("provenance",), dict)):
            for name in names:
                if not isinstance(plain[name], kind) or (isinstance(plain[name], bool) and kind is not bool):
                    raise ValueError(f"plan: {name}: expected another kind, received {plain[name]!r:.60}")
        if not (np.isfinite(float(plain["mass"])) and np.isfinite(float(plain["gravity"])) and len(plain["ee"])):
            raise ValueError("plan: expected a finite mass and gravity, and one step or more")
        try:
            plan = cls(**{name: plain[name] for name in expected})
            check_positive_definite(plan.stiffness)
            return plan
        except (TypeError, AttributeError, OverflowError, RecursionError) as error:
            raise ValueError(f"plan: values of other kinds than a plan has: {error}") from None


def _checked(plan: str, name: str, value: object, shape: tuple[int | str, ...], sizes: dict[str, int]) -> Array:
    """Return a read-only float64 copy of ``value``; letters in ``shape`` are bound by the first array that has them."""
    array = np.array(value, dtype=np.float64)
    if array.size == 0 and sizes["C"] == 0 and "C" in shape:  # JSON cannot tell (K, 0, 2) from (K, 0)
        array = array.reshape([sizes[size] if isinstance(size, str) else size for size in shape])
    matches = array.ndim == len(shape) and all(
        size == (sizes.setdefault(want, size) if isinstance(want, str) else want)
        for size, want in zip(array.shape, shape, strict=True)
    )
    if not matches:
        wanted = tuple(sizes.get(want, want) if isinstance(want, str) else want for want in shape)
        raise ValueError(f"plan '{plan}': {name}: expected shape {wanted}, received {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"plan '{plan}': {name}: expected finite numbers, received {array[~np.isfinite(array)][0]}")
    array.setflags(write=False)
    return array
