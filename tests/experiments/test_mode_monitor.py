"""The mode monitor on the station: what slips is found within two waypoints, and what does not is left alone."""

from __future__ import annotations

import json

import numpy as np
import pytest

from drivers.sim.mismatch import Lab, load_profile
from drivers.wire.log_reader import LogReader
from experiments import setup
from experiments.calibrate.store import Calibrations
from experiments.files import load
from experiments.planning.make import make
from mechanics import se2
from mechanics.friction import required_friction
from mechanics.records import TrialRecord, WaypointRecord
from planning.plan import Plan

SEEDS = (0, 1, 2)
MILLIMETRE = 1e-3


@pytest.fixture(scope="module")
def needed():
    """What µ the shipped plan of extrinsic pivoting needs at the ground, and what it believes there is."""
    resolved = load("extrinsic_pivoting")
    plan = make(resolved, resolved.experiment.stages[0], setup.believed(resolved, Calibrations()))  # type: ignore[arg-type]
    pivot = plan.contact_names.index("ground right")
    return float(required_friction(plan.contact_forces[:, pivot]).max()), float(plan.contact_mu[pivot])


def slippery(seed, needed):
    """How far the ground of this lab has to change for the pentagon to have 0.9 of the µ that its plan needs."""
    need, believed = needed
    in_lab = Lab(load_profile("lab"), seed).friction({"eo-ground": believed})["eo-ground"]
    return 0.9 * need / in_lab


def trial(run):
    """How the only trial of a run ended, its plan as anchored, and its waypoints with the plant's truth."""
    values = [value for _, value in LogReader(run.folder / "log.mcap").values()]
    [end] = [value for value in values if isinstance(value, TrialRecord) and value.status]
    return end, Plan.from_dict(json.loads(end.plan)), [value for value in values if isinstance(value, WaypointRecord)]


def true_slip(plan, waypoints, name="ground right"):
    """How far (K,) [m] a vertex of the extrinsic object has truly come along the ground since before touch-down."""
    c = plan.contact_names.index(name)
    vertex = se2.transform(se2.inverse(plan.eo[0]), plan.contact_points[0, c])
    at = np.array([se2.transform(waypoint.truth.eo, vertex) for waypoint in waypoints])
    return np.abs(at[:, 0] - se2.transform(plan.preload_eo[0], vertex)[0])  # where the plan is anchored


@pytest.mark.parametrize(
    ("law", "seed"),
    [
        ("open_loop", SEEDS[0]),
        *(pytest.param("open_loop", seed, marks=pytest.mark.slow) for seed in SEEDS[1:]),
        *(pytest.param("closed_loop", seed, marks=pytest.mark.slow) for seed in SEEDS),
    ],
)
def test_a_ground_ten_per_cent_under_the_need_ends_the_pivot_as_slipped(command, needed, law, seed):
    scale = f"world.friction_scale={{eo-ground: {slippery(seed, needed):.6f}}}"
    sets = ("world.profile=lab", scale, f"seed={seed}", f"stages.1.controllers=[{law}]")
    run = command.run("extrinsic_pivoting", *(part for one in sets for part in ("--set", one)))
    assert run.code == 1, run.err
    end, plan, waypoints = trial(run)
    told = run.trial(law)
    assert (told["status"], told["reason"]) == (end.status, end.reason)
    slip = true_slip(plan, waypoints)
    last = len(slip) - 1
    assert told["deviation"] == {"step": last, "status": end.status, "reason": end.reason}
    assert end.status == "slipped" and end.reason.startswith(f"waypoint {last}: contact 'ground right' has slipped")
    assert slip[last] > 0.5 * MILLIMETRE  # it has slipped indeed
    beyond = np.flatnonzero(slip >= MILLIMETRE)
    assert not len(beyond) or last <= beyond[0] + 2


@pytest.mark.slow
@pytest.mark.parametrize(("law", "seed"), [("open_loop", 0), ("closed_loop_pi", 1), ("mpc", 2)])
def test_a_tilted_object_that_slides_when_it_is_let_go_has_slipped_at_the_first_waypoint(command, law, seed):
    tilted = ("friction={eo-ground: 0.33}", "stages.0.parameters.angle_deg=[10,35]")
    resolved = load("extrinsic_pivoting", None, list(tilted))
    plan = make(resolved, resolved.experiment.stages[0], setup.believed(resolved, Calibrations()))  # type: ignore[arg-type]
    pivot = plan.contact_names.index("ground right")
    need = float(required_friction(plan.contact_forces[:, pivot]).max())
    scale = f"world.friction_scale={{eo-ground: {slippery(seed, (need, 0.33)):.6f}}}"
    sets = (*tilted, "world.profile=lab", scale, f"seed={seed}", f"stages.1.controllers=[{law}]")
    run = command.run("extrinsic_pivoting", *(part for one in sets for part in ("--set", one)))
    assert run.code == 1, run.err
    end, plan, waypoints = trial(run)
    assert end.status == "slipped" and len(waypoints) == 1
    assert end.reason.startswith("waypoint 0: contact 'ground right' has slipped")
    assert end.reason.endswith("since touch-down")
    if law != "open_loop":  # and nobody has followed it: the go is where its plan has it
        go, planned = waypoints[0].measured.go, waypoints[0].planned.go
        assert go is not None and planned is not None and np.hypot(*(go - planned)[:2]) < 3 * MILLIMETRE


@pytest.mark.slow
@pytest.mark.parametrize(
    "experiment",
    [
        *("grasped_static", "grasped_pivoting", "grasped_sliding", "static_in_contact"),
        *("relative_pivoting", "relative_sliding", "extrinsic_pushing", "extrinsic_pivoting"),
    ],
)
def test_no_trial_that_keeps_its_modes_is_ended_in_the_lab(command, experiment):
    run = command.finish(
        command.start_run(
            experiment, "--set", "world.profile=lab", "--set", "stages.1.controllers=[closed_loop]", out=experiment
        ),
        timeout=400,
    )
    assert run.code == 0, run.trial("closed_loop")["reason"]
    assert run.trial("closed_loop")["status"] == "completed"
