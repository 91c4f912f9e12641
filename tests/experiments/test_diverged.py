"""A simulated plant that diverges in the middle of a run: status `diverged`, exit code 1, and no NaN anywhere."""

from __future__ import annotations

import json
import socket
import threading
from dataclasses import replace
from math import nan

import pytest
from rich.console import Console

from drivers.errors import SimulationDiverged
from drivers.sim.host import Host
from drivers.sim.plant import Plant
from drivers.station import Station
from drivers.wire.bus import Bus
from drivers.wire.clock import RemoteSimulation
from experiments import setup
from experiments.exit_codes import ExitCode
from experiments.files import load
from experiments.runner import run

#: a step in the middle of the first trial
SICK = 5000


@pytest.fixture
def resolved():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    short = ["stages.0.parameters.steps=2", "stages.1.controllers=[open_loop]"]
    return load("grasped_static", None, ["world.profile=ideal", f"bus.endpoint=tcp/127.0.0.1:{port}", *short])


@pytest.fixture
def sick_station(resolved, monkeypatch):
    """The station, served in this process, whose plant loses its mind after `SICK` steps."""
    step = Plant.step

    def sicken(plant: Plant, X_W_ee, V_W_ee) -> None:
        if plant.steps == SICK:
            plant.data.qvel[0] = nan
        step(plant, X_W_ee, V_W_ee)

    monkeypatch.setattr(Plant, "step", sicken)
    config = resolved.station
    with Bus(config.bus.endpoint, listen=True, timeout=config.bus.timeout, shared_memory=False) as bus:
        host = Host(config, bus)
        serving = threading.Event()
        thread = threading.Thread(target=host.run, args=(serving.set,), name="sick host")
        thread.start()
        try:
            assert serving.wait(20)
            yield resolved
        finally:
            host.stop()
            thread.join(20)
    assert not thread.is_alive()


def test_divergence_reaches_the_other_process_as_what_it_is(sick_station):
    with Station(sick_station.station).connect() as devices:
        assert devices.simulation is not None
        devices.simulation.reset(0, setup.scene(sick_station).model_dump())
        with pytest.raises(SimulationDiverged, match="diverged") as caught:
            devices.clock.sleep(6.0)
        assert caught.value.device == "world" and caught.value.recoverable
        # a reset brings it back
        devices.simulation.reset(0, setup.scene(sick_station).model_dump())
        devices.clock.sleep(0.1)
        assert devices.simulation.health()["flags"] == []


def test_run_ends_as_diverged_with_one_and_without_nan(sick_station, tmp_path):
    outcome = run(sick_station, tmp_path / "run", Console(quiet=True))
    assert outcome.exit_code is ExitCode.FELL_SHORT
    text = (tmp_path / "run" / "results.json").read_text()
    results = json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} in results.json"))
    (trial,) = results["trials"]
    assert trial["status"] == "diverged"
    assert "the simulated state has diverged" in trial["reason"]
    assert results["status"] == "fell_short"
    assert results["health"]["seconds"] == pytest.approx(SICK * 1e-3)
    assert (tmp_path / "run" / "report.html").exists()


def test_stages_after_a_divergence_do_not_run_and_are_listed_with_the_reason(sick_station, tmp_path):
    first = sick_station.experiment
    plan, execute = first.stages
    later = (*first.stages, execute, plan.model_copy(update={"name": "another"}))
    again = replace(sick_station, experiment=first.model_copy(update={"stages": later}))
    outcome = run(again, tmp_path / "run", Console(quiet=True))
    assert outcome.exit_code is ExitCode.FELL_SHORT
    results = json.loads((tmp_path / "run" / "results.json").read_text())
    (trial,) = results["trials"]
    reason = f"{trial['name']} ended as diverged"
    assert results["not_run"] == [
        {"stage": "execute", "name": plan.name, "reason": reason},
        {"stage": "plan", "name": "another", "reason": reason},
    ]
    assert [made["name"] for made in results["plans"]] == [plan.name]
    events = [json.loads(line)["text"] for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert f"execute {plan.name}: not run, for {reason}" in events


def test_what_the_health_monitor_flags_is_a_warning_among_the_events(resolved, tmp_path, monkeypatch):
    """The flag is put into the station's answer; the figures are those of a short run on the ideal station."""
    asked = RemoteSimulation.health
    monkeypatch.setattr(RemoteSimulation, "health", lambda self: asked(self) | {"flags": ["bodies sank"]})
    outcome = run(resolved, tmp_path / "run", Console(quiet=True))
    assert outcome.exit_code is ExitCode.DONE, outcome.reason
    health = outcome.results["health"]
    assert health["flags"] == ["bodies sank"] and health["penetration_um"] < 10 and health["flicker_per_s"] == 0
    events = [json.loads(line) for line in (tmp_path / "run" / "events.jsonl").read_text().splitlines()]
    assert ("warning", "the simulated plant: bodies sank") in [(e["level"], e["text"]) for e in events]
