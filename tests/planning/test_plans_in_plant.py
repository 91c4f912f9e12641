"""Plans of all eight skills, executed open loop on the plant without mismatch: it has its own physics.

The end-effector goes from waypoint to waypoint along quintic ramps (0.2 s, and 0.5 s where something slides, so that it
comes to rest where it is left and not by its momentum), rests for 0.2 s, and is compared there. Modes are those of the
plant's own record: at rest where every contact sticks, half-way along a ramp where one slips.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest

from drivers.scene import Body
from drivers.scene import Scene as PlantScene
from drivers.sim.plant import Plant
from mechanics.catalogue import load_sensor
from planning.fused.objective import FusedObjective
from planning.optimisers.lm import LevenbergMarquardt
from planning.plan import Plan
from planning.planner import plan
from planning.skills.base import SKILLS, Scene
from tests.drivers.sim.oracle.motion import Hand

#: the kernels may have to be compiled first
pytestmark = pytest.mark.timeout(600)

APPROACH = 0.005  # [m] in front of the contact
RAMP, SLIDE, REST = 0.2, 0.5, 0.2  # [s]


@dataclass(frozen=True)
class Case:
    """A task, and the friction at the ground and the mass that it is for."""

    skill: str
    shape: str | None
    parameters: dict[str, Any]
    mu_ground: float = 0.33
    mass: float | None = None

    def __str__(self) -> str:
        told = " ".join(str(value) for key, value in self.parameters.items() if key not in ("contact_mm", "tilt_deg"))
        return f"{self.skill} {self.shape or ''} {told}".strip()


ON_CORNER = {"touch": "face_on_corner"}
CASES = (
    Case("grasped_static", None, {}),
    Case("grasped_static", None, {"angle_deg": 0}),
    Case("grasped_pivoting", None, {}),
    Case("grasped_sliding", None, {}),
    Case("grasped_sliding", None, {"travel_mm": -40}),
    Case("static_in_contact", "hbox", {}),
    Case("static_in_contact", "hbox", {**ON_CORNER, "tilt_deg": -30, "disturbance": 0.5}),
    Case("relative_pivoting", "hbox", {}),
    Case("relative_sliding", "hbox", {}),
    Case("relative_sliding", "hbox", {**ON_CORNER, "tilt_deg": -30, "travel_mm": -20}),
    Case("extrinsic_pushing", "hbox", {}),
    Case("extrinsic_pushing", "hbox", {"distance_mm": -30}),
    Case("extrinsic_pivoting", "tall_box", {}),
    Case("extrinsic_pivoting", "tall_box", {"pivot": "left"}),
    Case("extrinsic_pivoting", "tall_box", ON_CORNER),
    Case("extrinsic_pivoting", "z", {}),
    Case("extrinsic_pivoting", "heptagon", {}),
    Case("extrinsic_pivoting", "pentagon", {}, 0.5),
    Case("extrinsic_pivoting", "pentagon", {"angle_deg": (10, 35)}, mass=0.1),
    Case("extrinsic_pivoting", "triangle", {}, 0.8),
    Case("extrinsic_pivoting", "triangle", {"angle_deg": (30, 55)}, mass=0.1),
)


def modes_of(plant: Plant) -> dict[tuple[str, str], str]:
    """What the plant says of each pair of bodies that touch."""
    return {(contact.on, contact.by): contact.mode for contact in plant.contacts()}


def floats(values) -> tuple:
    return tuple(float(v) for v in values)


def world(p: Plan, scene: Scene, mu_ground: float) -> PlantScene:
    """The plant's scene as the plan finds it, the go a little off its contact."""
    away = p.contact_normals[0, 0] * (1.0 if p.eo is None else -1.0)
    start = p.preload_ee[0] + APPROACH * np.array([*away, 0.0])
    held, extrinsic = scene.held, scene.extrinsic
    friction, more = {"go-ground": 0.33}, {}
    if extrinsic is not None:
        assert p.preload_eo is not None
        friction |= {"go-eo": 0.33, "eo-ground": mu_ground}
        body = Body(name="eo", vertices=tuple(map(floats, extrinsic.vertices)), mass=extrinsic.mass)
        more = {"extrinsic": body, "extrinsic_pose": floats(p.preload_eo[0])}
    return PlantScene(
        grasped=Body(name="go", vertices=tuple(map(floats, held.vertices)), mass=held.mass),
        grasp=floats(p.X_go_gocf),
        stiffness=(floats(p.stiffness[0]), floats(p.stiffness[1]), floats(p.stiffness[2])),
        friction=friction,
        start=floats(start),
        **more,
    )


@dataclass
class Executed:
    """Largest errors over the waypoints: eo and go [mm, deg], force of the fingers [N]; eo at the end [mm, deg]."""

    errors: np.ndarray
    end: tuple[float, float]


def away(pose, planned) -> tuple[float, float]:
    """Distance [mm] and angle [deg] between two poses."""
    return float(np.hypot(*(pose - planned)[:2])) * 1e3, abs(math.degrees(pose[2] - planned[2]))


def execute(p: Plan, scene: Scene, mu_ground: float) -> Executed:
    """The whole plan, open loop; asserts the modes at every waypoint."""
    plant = Plant(world(p, scene, mu_ground))
    hand = Hand(plant)
    if p.supported:
        plant.clamp("eo")
    hand.ramp(p.preload_ee[0], 0.3)
    hand.rest(0.15)
    for ee in p.preload_ee[1:]:
        hand.ramp(ee, 0.1)
    hand.rest(0.3)
    if p.supported:
        plant.clamp(None)
        hand.rest(0.2)
    errors = []
    for k in range(p.steps):
        planned = {pair: p.contact_modes[k][c].value for c, pair in enumerate(p.contact_bodies or ())}
        slides = any(mode.startswith("slip") for mode in planned.values())
        under_way: dict[tuple[str, str], str] = {}
        hand.ramp(p.ee[k], SLIDE if slides else RAMP, lambda seen=under_way: seen.update(modes_of(plant)))
        hand.rest(REST)
        if k > 0 or not slides:
            assert (under_way if slides else modes_of(plant)) == planned, f"step {k}"
        eo = (0.0, 0.0) if p.eo is None else away(plant.eo, p.eo[k])
        force = float(np.hypot(*(plant.coupling_wrench() - p.wrench[k])[:2]))
        errors.append([*eo, *away(plant.go, p.go[k]), force])
    back = len(p.unload_ee) - len(p.preload_ee)
    for i, ee in enumerate(p.unload_ee):
        if i == back:
            hand.rest(REST)
            plant.clamp("eo" if p.supported else None)
        hand.ramp(ee, 0.1)
    hand.rest(0.1)
    end = (0.0, 0.0) if p.unload_eo is None else away(plant.eo, p.unload_eo[-1])
    assert plant.health()["flags"] == []
    return Executed(np.max(errors, axis=0), end)


def assert_it_does_what_it_says(case: Case, scene: Scene) -> None:
    """Plan and execute, and hold both to the tolerances: tight where all sticks, wider where something slides."""
    skill = SKILLS[case.skill]
    task = skill.task(skill.Parameters.model_validate(case.parameters), scene)
    p = plan(task, "p", optimiser=LevenbergMarquardt(), objective=FusedObjective)
    assert (p.status, p.provenance["shortfalls"]) == ("solved", [])
    done = execute(p, scene, case.mu_ground)
    slides = any(mode.slip_sign for row in p.contact_modes for mode in row)
    millimetres, degrees, newtons = (0.3, 0.3, 0.2) if slides else (0.05, 0.05, 0.05)
    eo_mm, eo_deg, go_mm, go_deg, force = done.errors
    assert max(eo_mm, go_mm) <= millimetres
    assert max(eo_deg, go_deg) <= degrees
    assert force <= newtons
    assert done.end[0] <= millimetres
    assert done.end[1] <= degrees


@pytest.mark.parametrize("case", CASES, ids=str)
def test_a_plan_executed_open_loop_does_what_it_says(case, scene_of):
    assert_it_does_what_it_says(case, scene_of(case.shape, case.mass, mu_ground=case.mu_ground))


@pytest.mark.parametrize("case", [case for case in CASES if case.shape in ("hbox", "pentagon")], ids=str)
def test_so_does_one_for_fingers_that_are_five_times_stiffer(case, scene_of):
    scene = scene_of(case.shape, case.mass, mu_ground=case.mu_ground)
    stiffness = load_sensor("gelslim").stiffness
    assert_it_does_what_it_says(case, replace(scene, held=replace(scene.held, stiffness=stiffness)))
