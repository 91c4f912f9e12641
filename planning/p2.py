"""The contact program P2 in closed form: a grasped object in contact with the static environment.

Extrinsic Contact Model, (P2). Unknowns are the contact forces f = (f_n, f_t) of the environment on the go, one per
contact and step, chosen by

    min Σ ½ (f − f_des)ᵀ U (f − f_des)   subject to the contacts' modes,   U diagonal.

The go's balance then *defines* the sensor's wrench on the go, about the grasp centre G in axes of W,

    w_ext = −τ_g,go − Σ Jᵀ f,

and the compliance the end-effector: X_W_ee = X_W_go ∘ X_go_gocf ∘ K⁻¹ w_ext. Every step is feasible by construction
(f = 0 meets every mode); what can fail is the wish, see `planning.planner`. Everything here is batched over K steps and
C contacts, in numpy or torch, and torch differentiates through it.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from array_api_compat import array_namespace

from mechanics import se2
from mechanics._shapes import Array, load
from mechanics.contact import gravity_wrench, jacobian
from mechanics.elasticity import Elasticity
from mechanics.friction import Mode, project_to_mode
from planning.task import Task

Modes: TypeAlias = tuple[tuple[Mode, ...], ...]


@dataclass(frozen=True, eq=False)
class P2:
    """The data of K programs with C contacts each.

    ``modes`` K × C; ``desired`` (K, C, 2) f_des [N]; ``mu`` (K, C); ``weights`` (K, C, 2) the diagonal of U, positive;
    ``normals`` (K, C, 2) in W; ``arms`` (K, C, 2) [m] from the grasp centre to each contact, axes of W;
    ``gravity_wrench`` (K, 3) τ_g,go about the grasp centre, axes of W; ``go`` (K, 3) X_W_go; ``X_go_gocf`` (3,);
    ``stiffness`` (3, 3). Raises ValueError naming the field whose shape or values do not fit.
    """

    modes: Modes
    desired: Array
    mu: Array
    weights: Array
    normals: Array
    arms: Array
    gravity_wrench: Array
    go: Array
    X_go_gocf: Array
    stiffness: Array

    def __post_init__(self) -> None:
        K, C = len(self.modes), len(self.modes[0]) if self.modes else 0
        shapes = {"desired": (K, C, 2), "mu": (K, C), "weights": (K, C, 2), "normals": (K, C, 2), "arms": (K, C, 2)}
        shapes |= {"gravity_wrench": (K, 3), "go": (K, 3), "X_go_gocf": (3,), "stiffness": (3, 3)}
        for name, shape in shapes.items():
            _, array = load("P2", **{name: (getattr(self, name), ())})
            if array.shape != shape:
                raise ValueError(f"P2: {name}: expected shape {shape}, received {tuple(array.shape)}")
            if not bool(array_namespace(array).all(array_namespace(array).isfinite(array))):
                raise ValueError(f"P2: {name}: expected finite numbers")
            object.__setattr__(self, name, array)
        if bool((self.weights <= 0).any()):
            raise ValueError("P2: weights: expected positive numbers")
        if bool((self.mu < 0).any()):
            raise ValueError("P2: mu: expected numbers ≥ 0")

    @property
    def steps(self) -> int:
        """K."""
        return len(self.modes)

    def wrench(self, forces: Array) -> Array:
        """Return w_ext (K, 3) for ``forces`` (K, C, 2): of the sensor on the go about the grasp centre, axes of W."""
        _, forces, normals, arms = load(
            "P2.wrench", forces=(forces, (2,)), normals=(self.normals, (2,)), arms=(self.arms, (2,))
        )
        J = jacobian(normals, arms)
        from_contacts = (J * forces[..., None]).sum(-2).sum(-2)  # Jᵀ f, summed over contacts
        _, gravity, from_contacts = load(
            "P2.wrench", gravity_wrench=(self.gravity_wrench, (3,)), from_contacts=(from_contacts, (3,))
        )
        return -gravity - from_contacts

    def ee(self, wrench: Array) -> Array:
        """Return X_W_ee (K, 3), which makes the sensor's ``wrench`` (K, 3) on the go at the program's poses."""
        return Elasticity(self.stiffness).ee_pose(self.go, self.X_go_gocf, wrench)

    def objective(self, forces: Array) -> Array:
        """Return ½ Σ (f − f_des)ᵀ U (f − f_des) per step, (K,) [N² by the weights' unit]."""
        _, forces, desired, weights = load(
            "P2.objective", forces=(forces, (2,)), desired=(self.desired, (2,)), weights=(self.weights, (2,))
        )
        return 0.5 * (weights * (forces - desired) ** 2).sum(-1).sum(-1)


@dataclass(frozen=True, eq=False)
class Solution:
    """Forces (K, C, 2) that solve a `P2`, and how well.

    ``status`` per step is ``solved``, ``inaccurate`` (the residual exceeds the solver's promise) or ``failed``
    (``forces`` are 0 there). ``residual`` (K,) is the largest violation of the optimality conditions, as a fraction of
    the step's largest desired force; 0 where the solver is a closed form.
    """

    forces: Array
    status: tuple[str, ...]
    residual: Array = field(default_factory=lambda: np.empty(0))


Backend: TypeAlias = Callable[[P2], Solution]
"""Something that solves a `P2`."""


def pose(task: Task, *, level: Sequence[float] | Array | None = None, steps: Sequence[int] | None = None) -> P2:
    """Return P2 of a task's ``steps`` (default: all), each with its desired forces scaled by ``level`` (default: 1)."""
    index = np.arange(task.steps) if steps is None else np.asarray(steps, dtype=np.intp)
    scale = np.ones(len(index)) if level is None else np.asarray(level, dtype=np.float64)
    contacts, C = task.contacts, len(task.contacts)
    go = task.go[index]

    def stacked(values: list[Array], *tail: int) -> Array:
        return np.stack(values, axis=1) if values else np.empty((len(index), 0, *tail))

    points = np.stack([contact.p_goC for contact in contacts]) if contacts else np.empty((0, 2))
    theta = go[:, 2]
    return P2(
        modes=tuple(tuple(contact.modes[k] for contact in contacts) for k in index),
        desired=stacked([contact.force[index] * scale[:, None] for contact in contacts], 2),
        mu=stacked([np.full(len(index), contact.mu) for contact in contacts]),
        weights=np.ones((len(index), C, 2)),
        normals=stacked([contact.normal[index] for contact in contacts], 2),
        arms=se2.rotate(theta[:, None], points - task.X_go_gocf[:2]),
        gravity_wrench=gravity_wrench(task.mass, se2.rotate(theta, task.com - task.X_go_gocf[:2]), task.gravity),
        go=go,
        X_go_gocf=task.X_go_gocf,
        stiffness=task.stiffness,
    )


def solve_by_projection(problem: P2) -> Solution:
    """Solve P2 exactly: nothing couples its contacts, so each force is f_des projected onto what its mode admits."""
    xp, desired, mu, weights = load(
        "solve_by_projection", desired=(problem.desired, (2,)), mu=(problem.mu, ()), weights=(problem.weights, (2,))
    )
    forces = 0 * (desired + mu[..., None] + weights)  # where all is free, torch still finds its inputs
    codes = np.array(problem.modes, dtype=object).reshape(forces.shape[:2])
    for mode in set(codes.ravel()) - {Mode.FREE}:
        mask = xp.asarray((codes == mode)[..., None], device=forces.device)
        forces = xp.where(mask, project_to_mode(desired, mode, mu, weights), forces)
    return Solution(forces, ("solved",) * problem.steps, np.zeros(problem.steps))
