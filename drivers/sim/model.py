"""The MuJoCo model of a scene: prisms on planar joints over a ground plane, with contacts tuned for quasi-statics.

The task plane is MuJoCo's x–z plane: planar x → X, planar y → Z, and a counter-clockwise angle turns about −Y. Every
body has the degrees of freedom (x, y, θ) of its frame in W, in this order, the go first, the eo after it.
"""

from __future__ import annotations

import logging
from typing import Any

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
#: contact stiffness and damping: time constant [s], damping ratio. The solver leaves out the acceleration ω² r of a
#: vertex that something turns about, so the vertex walks by half the time constant times ∫ ω² r dt
SOLREF = (0.0035, 1.0)
#: contact impedance. The share it leaves to 1, times the force over the effective mass, must outweigh that same ω² r:
#: at 0.998 a block of 0.5 kg, turned about its corner by 2° in 0.2 s, loses contact at each ramp and walks by 0.05 mm,
#: at 0.9999 lighter ones do too. What it leaves also lets bodies sink in, by the square of the time constant
SOLIMP = (0.996, 0.996, 0.001, 0.5, 2.0)
#: friction is this much stiffer than the normal direction: a sticking contact must not creep
FRICTION_IMPEDANCE = 1e4


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
                    solref=SOLREF,
                    solimp=SOLIMP,
                )
    return spec.compile()


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
