"""What a scene is refused for before anything starts: known from its numbers alone, without the physics engine."""

from __future__ import annotations

from math import cos, inf, isfinite, pi, sin

import numpy as np
import shapely
from numpy.typing import ArrayLike

from drivers.scene import Scene
from drivers.sim.coupling import Coupling
from drivers.sim.membrane import Membrane
from mechanics.polygon import Polygon
from mechanics.readings import Array

#: the push that a grasp must carry without spinning out [N], in so many steps from nothing
PUSH, PUSH_STEPS = 10.0, 10
#: a go that turns by more than this in the fingers [rad] has spun out: small-angle stiffness says nothing there
SPUN_OUT = pi / 6
#: bodies that stand on each other overlap by their rounding [m]
TOUCHING = 1e-4


def coupling_of(
    scene: Scene,
    stiffness_scale: float = 1.0,
    membrane: Membrane | None = None,
    finger_limit: tuple[float, float] = (inf, inf),
) -> Coupling:
    """The fingers of a scene. Raises ValueError for a stiffness that is not symmetric positive definite."""
    body = scene.grasped
    inertia = Polygon(np.asarray(body.vertices)).inertia(body.mass)
    stiffness = np.array(scene.stiffness) * stiffness_scale
    return Coupling(stiffness, scene.grasp, body.mass, inertia, membrane, finger_limit)


def refuse_impossible(scene: Scene, coupling: Coupling) -> None:
    """Raise ValueError, which names the key of the scene first, for a scene that cannot be set up.

    Refused are: a pair of bodies without friction, fingers that cannot hold the go (`refuse_unstable`), bodies that
    start inside each other or the ground.
    """
    if scene.extrinsic is not None and scene.extrinsic_pose is None:
        raise ValueError("scene.extrinsic_pose: missing; an extrinsic body needs its pose in W")
    refuse_friction(scene)
    refuse_unstable(coupling, np.asarray(scene.grasped.vertices), scene.start, scene.gravity)
    refuse_overlap(scene, coupling)


def refuse_friction(scene: Scene) -> None:
    """Every pair that can touch needs a coefficient above 0."""
    pairs = ["go-ground"] if scene.extrinsic is None else ["go-ground", "go-eo", "eo-ground"]
    for pair in pairs:
        if pair not in scene.friction:
            raise ValueError(f"scene.friction: no coefficient for '{pair}'; it has {sorted(scene.friction) or 'none'}")
    for pair, mu in scene.friction.items():
        if not (isfinite(mu) and mu > 0):
            raise ValueError(f"scene.friction: '{pair}' is {mu:g}; expected a number above 0")


def refuse_overlap(scene: Scene, coupling: Coupling) -> None:
    """Bodies where they start: the go as it hangs from the ee, clear of everything; the eo clear of the ground."""
    go = _outline(scene.grasped.vertices, coupling.sagged(scene.start, scene.gravity))
    depth = -float(go[:, 1].min())
    if depth > 0:
        raise ValueError(f"scene.start: go and ground overlap by {depth * 1e3:.3g} mm at the start; raise it")
    if scene.extrinsic is None or scene.extrinsic_pose is None:
        return
    eo = _outline(scene.extrinsic.vertices, scene.extrinsic_pose)
    depth = -float(eo[:, 1].min())
    if depth > TOUCHING:
        raise ValueError(f"scene.extrinsic_pose: eo and ground overlap by {depth * 1e3:.3g} mm at the start; raise it")
    common = shapely.intersection(shapely.Polygon(go), shapely.Polygon(eo)).area
    if common > 0:
        raise ValueError(
            f"scene.start: go and eo overlap over {common * 1e6:.3g} mm² at the start; "
            f"raise it, or move scene.extrinsic_pose"
        )


def refuse_unstable(coupling: Coupling, vertices: ArrayLike, ee: ArrayLike, gravity: float, push: float = PUSH) -> None:
    """Refuse fingers in which the go spins out: under its weight, or as ``push`` [N] grows at one of its vertices.

    The push is a dead load along the line from the vertex to the grasp centre, the worst that a slipping contact can
    do: fingers of torsional stiffness k carry it as long as force times lever is below k. With the forces given, the
    balance of torques is r(φ) = φ + x_θ(φ) − θ_ee = 0 with x = K⁻¹w(φ); the grasp is stable where r′ > 0. It is
    followed from no load up to the whole, so that it is the grasp's own equilibrium that is judged and no other.
    """
    ee_angle = float(np.asarray(ee, float)[2])
    compliance = np.linalg.inv(coupling.stiffness)[2]
    px, py, turn = coupling.grasp
    weight = np.array([0.0, -coupling.mass * gravity])
    # levers from the grasp centre, in the go's axes: of the weight, and of every vertex
    centre = np.array([-px, -py])
    for vertex in np.asarray(vertices, float) - [px, py]:
        reach = float(np.hypot(*vertex))
        if reach < 1e-6:
            continue
        phi = ee_angle
        towards = -(_axes(phi - turn) @ vertex) / reach
        for share in np.linspace(0.0, 1.0, PUSH_STEPS + 1):
            phi, slope = _balanced(
                phi, ee_angle, turn, compliance, ((centre, weight), (vertex, share * push * towards))
            )
            if not slope > 0 or abs(phi - ee_angle) > SPUN_OUT:
                load = "its weight" if share == 0 else f"a push of {share * push:.1f} N, less than {push:g} N,"
                raise ValueError(
                    f"scene.stiffness: the fingers are too soft: {load} makes the go spin out of the grasp; stiffen "
                    f"them (a torsional stiffness above {push * reach:.2g} N·m/rad is enough), or grasp nearer to the "
                    f"vertex at {np.round((vertex - centre) * 1e3, 1).tolist()} mm"
                )


def _balanced(
    phi: float, ee_angle: float, turn: float, compliance: Array, loads: tuple[tuple[Array, Array], ...]
) -> tuple[float, float]:
    """gocf's angle near ``phi`` in balance under dead loads at levers, and r′ there; not positive: there is none."""
    slope = 0.0
    for _ in range(50):
        axes = _axes(phi - turn)
        fx = fy = tau = lean = 0.0
        for lever, force in loads:
            x, y = axes @ lever
            fx, fy = fx - force[0], fy - force[1]
            tau -= x * force[1] - y * force[0]
            lean += x * force[0] + y * force[1]  # dτ/dφ: the lever turns with the go, the force does not
        c, s = cos(phi), sin(phi)
        in_x, in_y = c * fx + s * fy, c * fy - s * fx
        error = phi + compliance[0] * in_x + compliance[1] * in_y + compliance[2] * tau - ee_angle
        slope = 1.0 + compliance[0] * in_y - compliance[1] * in_x + compliance[2] * lean
        if not slope > 0 or not isfinite(error):
            return phi, 0.0
        if abs(error) < 1e-12:
            return phi, slope
        phi -= max(-0.2, min(0.2, error / slope))
    return phi, 0.0


def _axes(angle: float) -> Array:
    c, s = cos(angle), sin(angle)
    return np.array([[c, -s], [s, c]])


def _outline(vertices: ArrayLike, pose: ArrayLike) -> Array:
    return np.asarray(Polygon(np.asarray(vertices, float)).transformed(pose).vertices)
