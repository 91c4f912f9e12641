"""The paper's errors, from waypoints: measured minus planned, once through the sensors and once through the truth.

Wrench: of the sensor on the go about the grasp centre, axes of W. Angles and torques join lengths and forces through a
radius of gyration ρ: the own object's for poses, the go's for wrenches (design §6).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from shapely import MultiPoint, Point

from estimation.finger_slip import Drift
from estimation.tool_identification import Agreement
from mechanics import se2
from mechanics.friction import Mode
from mechanics.polygon import Polygon
from mechanics.readings import Array
from mechanics.records import PlanarState, WaypointRecord
from planning.plan import Plan

#: a planned contact farther from the go's outline than this is another body's [m]
_ON_GO = 1e-4

Figure = dict[str, float]


def _figure(values: Array) -> Figure:
    return {"mean": float(np.mean(values)), "std": float(np.std(values))}


def pose_errors(actual: Iterable[Array], planned: Iterable[Array]) -> Array:
    """Signed errors (K, 3) = (dx, dy, dθ) [m, m, rad] of poses (K, 3), angles wrapped to ±π."""
    errors = np.array(list(actual), float) - np.array(list(planned), float)
    errors[:, 2] = se2.wrap(errors[:, 2])
    return errors


def pose_norm(errors: Array, rho: float) -> Array:
    """‖(dx, dy, ρ dθ)‖ [m] per waypoint of pose errors (K, 3)."""
    return np.linalg.norm(errors * [1.0, 1.0, rho], axis=-1)


def wrench_norm(errors: Array, rho: float) -> Array:
    """‖(dfx, dfy, dτ/ρ)‖ [N] per waypoint of wrench errors (K, 3)."""
    return np.linalg.norm(errors / [1.0, 1.0, rho], axis=-1)


def errors_of(
    waypoints: Sequence[WaypointRecord], witness: str, rho_go: float, rho_eo: float | None, rho_wrench: float
) -> dict[str, Figure | None] | None:
    """The figures M of design §6 over ``waypoints``, as seen by ``witness`` (``measured`` or ``truth``).

    None where there is no waypoint or no witness. Poses of an object that was not seen at a waypoint are left out; an
    object never seen has None for its figures.
    """
    pairs = [(w.planned, getattr(w, witness)) for w in waypoints if getattr(w, witness) is not None]
    if not pairs:
        return None
    wrench = np.array([actual.wrench - planned.wrench for planned, actual in pairs])
    go, eo = _object_errors(pairs, "go"), _object_errors(pairs, "eo")
    own = go if eo is None else eo
    components: dict[str, Array | None] = {
        "fx_N": wrench[:, 0],
        "fy_N": wrench[:, 1],
        "tau_Nmm": wrench[:, 2] * 1e3,
        "x_mm": None if own is None else own[:, 0] * 1e3,
        "y_mm": None if own is None else own[:, 1] * 1e3,
        "theta_deg": None if own is None else np.degrees(own[:, 2]),
    }
    return {
        "go_pose_mm": None if go is None else _figure(pose_norm(go, rho_go) * 1e3),
        "eo_pose_mm": None if eo is None or rho_eo is None else _figure(pose_norm(eo, rho_eo) * 1e3),
        "wrench_N": _figure(wrench_norm(wrench, rho_wrench)),
        **{key: None if values is None else _figure(np.abs(values)) for key, values in components.items()},
    }


def _object_errors(pairs: list[tuple[PlanarState, PlanarState]], body: str) -> Array | None:
    seen = [
        (getattr(actual, body), getattr(planned, body))
        for planned, actual in pairs
        if getattr(actual, body) is not None and getattr(planned, body) is not None
    ]
    return pose_errors(*zip(*seen, strict=True)) if seen else None


def contact_of(waypoints: Sequence[WaypointRecord], plan: Plan, outline: Polygon) -> dict[str, Any] | None:
    """How far the contact on the go was believed to be from where ``plan`` has it, over ``waypoints``.

    ``mean_mm`` and ``max_mm`` are over the ``waypoints`` with one known place (None where there is none); between
    several planned contacts of the go, as of a face that lies flat, the distance is zero. ``not_located`` counts
    the waypoints where the plan has the go, of ``outline``, touched and the place was not known. None where nobody
    looked for it.
    """
    distances: list[float] = []
    unknown = 0
    for waypoint in waypoints:
        planned = _planned_on_go(plan, waypoint.step, outline)
        if waypoint.contact is None or not len(planned):
            continue
        if waypoint.contact.point is None:
            unknown += 1
        else:
            distances.append(float(MultiPoint(planned).convex_hull.distance(Point(waypoint.contact.point))) * 1e3)
    if not distances and not unknown:
        return None
    return {
        "mean_mm": float(np.mean(distances)) if distances else None,
        "max_mm": max(distances, default=None),
        "waypoints": len(distances),
        "not_located": unknown,
    }


def _planned_on_go(plan: Plan, step: int, outline: Polygon) -> Array:
    """The planned contacts (n, 2) of the go at a step, in its frame."""
    points = se2.transform(se2.inverse(plan.go[step]), plan.contact_points[step])
    touches = np.array([mode is not Mode.FREE for mode in plan.contact_modes[step]], bool)
    return points[touches & (np.abs(outline.signed_distance(points)) < _ON_GO)]


def witness_of(found: Sequence[Agreement]) -> dict[str, Any] | None:
    """How far [N] the sensor under the table and the wrist were apart, over a trial; None where it said nothing."""
    if not found:
        return None
    apart = [float(np.hypot(*one.difference)) for one in found]
    disagreements = sum(not one.agrees for one in found)
    return {"mean_N": float(np.mean(apart)), "max_N": max(apart), "disagreements": disagreements}


def finger_slip_of(drifts: Mapping[int, Drift], said: str) -> dict[str, Any] | None:
    """How far the object came to lie elsewhere in the fingers than in free air, beyond what their elasticity says.

    ``mm`` and ``deg`` are the most of all waypoints, ``sigmas`` by what they could be without a slip; ``detected``
    whether it has slipped, and ``reason`` what was ``said`` of it. None where nobody saw where it lies.
    """
    if not drifts and not said:
        return None
    sizes = {name: [getattr(one, name) for one in drifts.values()] for name in ("size_mm", "size_deg", "sigmas")}
    most = {name.removeprefix("size_"): max(values, default=None) for name, values in sizes.items()}
    return {**most, "detected": bool(said), "reason": said}


def paper_summary(figures: dict[str, Figure], rho: float) -> dict[str, float]:
    """The "summary" columns of the paper's Table 3: norms of the component *means*, poses by x and y only.

    Another arithmetic than `errors_of`'s aggregates; ``rho`` [m] is the extrinsic object's radius of gyration.
    """
    fx, fy, tau = (figures[key]["mean"] for key in ("fx_N", "fy_N", "tau_Nmm"))
    return {
        "wrench_summary_N": float(np.linalg.norm([fx, fy, tau / (rho * 1e3)])),
        "pose_summary_mm": float(np.hypot(figures["x_mm"]["mean"], figures["y_mm"]["mean"])),
    }
