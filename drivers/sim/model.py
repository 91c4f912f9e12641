"""The MuJoCo model of a scene: prisms on planar joints over a ground plane, with contacts tuned for quasi-statics.

The task plane is MuJoCo's x–z plane: planar x → X, planar y → Z, and a counter-clockwise angle turns about −Y. Every
body has the degrees of freedom (x, y, θ) of its frame in W, in this order, the go first, the eo after it.
"""

from __future__ import annotations

import logging
from math import hypot
from typing import Any, NamedTuple

import mujoco as _mujoco
import numpy as np
from numpy.typing import NDArray

from drivers.scene import Body, Scene
from mechanics.polygon import Polygon
from mechanics.readings import Array

#: the bindings are compiled and come without type information
mujoco: Any = _mujoco
#: MuJoCo would otherwise write its warnings to a file in the current folder
mujoco.set_mju_user_warning(logging.getLogger(__name__).warning)

#: half the depth of every prism [m]: contacts come in pairs at ±this depth, which keeps them symmetric
HALF_DEPTH = 0.02
#: contact stiffness and damping, minus k [1/s²] and minus b [1/s]: as stiff as steps of 1 ms bear. The solver leaves
#: out the acceleration ω² r of a vertex that something turns about, so the vertex walks by 1/b times ∫ ω² r dt
SOLREF = (-4e5, -1000.0)
#: contact impedance. The share it leaves to 1, times the force over the effective mass, is what a contact can give way
#: by [m/s²]; it must outweigh that same ω² r, or the contact opens: at 0.9999 contacts flicker at each ramp. What it
#: leaves also lets bodies sink in, by that over k
SOLIMP = (0.98, 0.98, 0.001, 0.5, 2.0)
#: friction is this much stiffer than the normal direction: a sticking contact must not creep
FRICTION_IMPEDANCE = 1e4
#: how much of what a contact can give way by its slip may take, see `Glide`
GLIDE = 0.5
#: (1 − d) / d of the impedance d of a slipping contact: its most, and what is left of it a step later
MOST_COMPLIANCE, FADING = 4.0, 0.9
#: a contact that slips and opens is the same one within so many steps
BACK = 10
#: what is slower does not slip [m/s]
CREEP = 2e-5


def polar_inertia(body: Body) -> float:
    """Moment of inertia [kg·m²] of a uniform body about its frame's origin, the centroid."""
    return Polygon(np.asarray(body.vertices)).inertia(body.mass)


def build(scene: Scene, timestep: float) -> Any:
    """Compile the scene. Geoms are named ``ground``, ``go…`` and ``eo…``. Raises ValueError for a missing friction."""
    spec = mujoco.MjSpec()
    option = spec.option
    option.timestep = timestep
    option.gravity = (0.0, 0.0, -scene.gravity)
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    option.impratio = FRICTION_IMPEDANCE
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.iterations = 200
    option.tolerance = 1e-10
    # a diverged state must be seen, not silently replaced by the initial one
    option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)

    world = spec.worldbody
    world.add_geom(name="ground", type=mujoco.mjtGeom.mjGEOM_PLANE, size=(5, 5, 0.1), contype=0, conaffinity=0)
    geoms = {"ground": ["ground"], "go": _add_body(spec, "go", scene.grasped)}
    # each contact is by the first on the second: MuJoCo orders the two by body, and the bodies are in this order
    # the longest step that bears the stiffness is 1 ms
    soft = min(1.0, 0.001 / timestep)
    solref = SOLREF[0] * soft**2, SOLREF[1] * soft
    pairs = [("ground", "go", "go-ground")]
    if scene.extrinsic is not None:
        geoms["eo"] = _add_body(spec, "eo", scene.extrinsic)
        pairs += [("go", "eo", "go-eo"), ("ground", "eo", "eo-ground")]
    for by, on, name in pairs:
        mu = _friction(scene, name)
        for a in geoms[by]:
            for b in geoms[on]:
                # an explicit pair, since MuJoCo would take the larger of the two bodies' own coefficients
                spec.add_pair(
                    geomname1=a,
                    geomname2=b,
                    condim=3,
                    friction=(mu, mu, 0.0, 0.0, 0.0),
                    solref=solref,
                    solreffriction=solref,
                    solimp=SOLIMP,
                )
    return spec.compile()


class Glide:
    """Keeps slipping contacts closed and at their cone: sets their friction's damping b and their impedance d per step.

    The solver's convex friction drives bodies that slip past each other apart, with the acceleration µ (a + b v) of
    the slip's speed v and acceleration a. Beyond what the contact gives way by, R f, it opens for a step, closes with a
    blow, and the bodies leap by some 30 µm: with a constant b, thirty times a second at 1 mm/s. Where a + b v is
    negative, on the other hand, the solver takes the contact for a sticking one. So b is what makes it a fixed share
    of R f / µ; where a alone is more, R is raised by way of d, at the same stiffness.
    """

    def __init__(self, model: Any, data: Any):
        self._data, self._timestep = data, model.opt.timestep
        self._knobs = list(zip(model.pair_solimp, model.pair_solref, model.pair_solreffriction, strict=True))
        self._at_rest = [tuple(knob.copy() for knob in knobs) for knobs in self._knobs]
        self._stiffness, self._most = model.pair_solref[0].tolist()
        self._impedance = float(model.pair_solimp[0, 0])
        self._compliance = 1 / self._impedance - 1
        self._friction = model.pair_friction[:, 0].tolist()
        ends = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
        self._pair = {end: i for i, (a, b) in enumerate(ends) for end in ((a, b), (b, a))}
        self._slips: dict[int, _Slip] = {}
        self._steps = 0

    def look(self) -> None:
        """Called after every step, for the next one."""
        self._steps += 1
        speeds = self._data.efc_vel.tolist()
        if not self._slips and not (speeds and (max(speeds) > CREEP or min(speeds) < -CREEP)):
            return
        loaded = self._loaded(speeds)
        for pair, loads in loaded.items():
            speed, before = max(loads).speed, self._slips.get(pair)
            sticking = all(load.inside for load in loads) and (before is None or before.damping >= -self._most)
            if speed > CREEP and not sticking:
                before = before or _Slip(0.0, self._steps - 1, self._compliance, -self._most)
                self._slips[pair] = self._adjust(pair, loads, speed, before)
        for pair, slip in list(self._slips.items()):
            # a contact that has opened will be back in a moment
            if slip.step < self._steps and (pair in loaded or slip.step < self._steps - BACK):
                for knob, value in zip(self._knobs[pair], self._at_rest[pair], strict=True):
                    knob[:] = value
                del self._slips[pair]

    def _adjust(self, pair: int, loads: list[_Load], speed: float, before: _Slip) -> _Slip:
        change = (speed - before.speed) / (self._steps - before.step)
        acceleration = change / self._timestep
        # contacts that slip and are held inside their cones would slow down by more
        if acceleration < 0 and all(load.inside for load in loads):
            acceleration *= 2
        free = min(load.yielding for load in loads) / before.compliance
        # what one step asks for is not forgotten in the next
        needed = max(acceleration / (GLIDE * free), FADING * before.compliance, self._compliance)
        compliance = min(needed, MOST_COMPLIANCE)
        damping = max(GLIDE * compliance * free - acceleration, 0.0) / max(speed + change, CREEP)
        self._set(pair, compliance, damping)
        return _Slip(speed, self._steps, compliance, damping)

    def _set(self, pair: int, compliance: float, damping: float) -> None:
        impedance = 1 / (1 + compliance)
        share = impedance / self._impedance  # by which the solver divides stiffness and damping
        solimp, normal, friction = self._knobs[pair]
        solimp[0] = solimp[1] = impedance
        normal[0] = friction[0] = self._stiffness * share
        normal[1], friction[1] = self._most * share, max(-damping, self._most) * share

    def _loaded(self, speeds: list[float]) -> dict[int, list[_Load]]:
        """Of each pair the contacts that carry a good part of its load."""
        contact, forces, compliance = self._data.contact, self._data.efc_force.tolist(), self._data.efc_R.tolist()
        found: dict[int, list[_Load]] = {}
        for i, (one, other) in zip(contact.efc_address.tolist(), contact.geom.tolist(), strict=True):
            if i >= 0 and (force := forces[i]) > 0:
                pair = self._pair[one, other]
                mu = self._friction[pair]
                speed, friction = hypot(speeds[i + 1], speeds[i + 2]), hypot(forces[i + 1], forces[i + 2])
                load = _Load(force, speed, compliance[i] * force / mu, friction < 0.99 * mu * force)
                found.setdefault(pair, []).append(load)
        return {pair: [load for load in loads if load.force > 0.1 * max(loads).force] for pair, loads in found.items()}


class _Slip(NamedTuple):
    """A pair that slips: its speed [m/s] when it was last seen, in which step, and what it has been given since."""

    speed: float
    step: int
    compliance: float
    damping: float


class _Load(NamedTuple):
    """A contact: normal force [N], slip [m/s], the slip's a + b v that opens it [m/s²], whether it is in its cone."""

    force: float
    speed: float
    yielding: float
    inside: bool


def _friction(scene: Scene, pair: str) -> float:
    if pair not in scene.friction:
        raise ValueError(f"scene.friction: no coefficient for '{pair}'; it has {sorted(scene.friction) or 'none'}")
    return scene.friction[pair]


def _add_body(spec: Any, name: str, shape: Body) -> list[str]:
    """Add a polygon as a free planar body of convex prisms; returns the names of its geoms."""
    polygon = Polygon(np.asarray(shape.vertices))
    if np.hypot(*polygon.centroid) > 1e-3 * polygon.bounding_radius:
        raise ValueError(
            f"body '{shape.name}': the frame's origin must be the centroid, which is at {polygon.centroid}"
        )
    body = spec.worldbody.add_body(name=name)
    body.explicitinertial = True
    body.mass = shape.mass
    # only the moment about Y acts; all three are alike so that MuJoCo's triangle inequality holds
    body.inertia = np.full(3, polygon.inertia(shape.mass))
    joint = mujoco.mjtJoint
    body.add_joint(name=f"{name}_x", type=joint.mjJNT_SLIDE, axis=(1, 0, 0))
    body.add_joint(name=f"{name}_y", type=joint.mjJNT_SLIDE, axis=(0, 0, 1))
    body.add_joint(name=f"{name}_theta", type=joint.mjJNT_HINGE, axis=(0, -1, 0))
    names = []
    for i, piece in enumerate(polygon.convex_pieces()):
        part = f"{name}{i}"
        spec.add_mesh(name=part, uservert=_prism(piece).ravel().tolist())
        body.add_geom(name=part, type=mujoco.mjtGeom.mjGEOM_MESH, meshname=part, contype=0, conaffinity=0)
        names.append(part)
    return names


def _prism(piece: NDArray) -> Array:
    """Vertices (2n, 3) of the convex polygon (n, 2) extruded along Y."""
    n = len(piece)
    corners = np.zeros((2 * n, 3))
    corners[:, 0] = np.tile(piece[:, 0], 2)
    corners[:, 1] = np.repeat([-HALF_DEPTH, HALF_DEPTH], n)
    corners[:, 2] = np.tile(piece[:, 1], 2)
    return corners
