"""The trial protocol on the simulated station in this process: what it does, and how it ends when things go wrong."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from control.base import Controller
from control.closed_loop import ClosedLoop
from control.observe import Observer
from control.open_loop import OpenLoop
from control.settings import TrialSettings
from control.trial import Trial, Watch
from drivers.errors import CommandRefused, DeviceFault
from drivers.sim.world import World
from estimation.force_torque import FreeAirLoad, WristSensor
from experiments import setup
from experiments.calibrate.store import Calibrations
from experiments.files import load
from experiments.planning.make import make
from mechanics.camera import CameraModel
from mechanics.records import WaypointRecord
from planning.plan import Plan

STEPS = 3


class Station:
    """A world, its devices open, and a trial waiting to be run."""

    def __init__(self, *sets):
        self.resolved = load("grasped_static", None, [f"stages.0.parameters.steps={STEPS}", *sets])
        self.world = World(self.resolved.station)
        self.devices: dict[str, Any] = dict(self.world.devices)
        for device in self.devices.values():
            device.connect()
        self.world.reset(0, setup.scene(self.resolved))
        self.world.advance(0.2)
        self.arm = self.devices["arm"]
        self.arm.acquire("test")
        stage: Any = self.resolved.experiment.stages[0]
        self.plan = make(self.resolved, stage, setup.believed(self.resolved, Calibrations()))
        self.events: list[tuple[str, str]] = []
        self.phases: list[str] = []
        self.waypoints: list[WaypointRecord] = []
        self.felt: list[np.ndarray] = []

    def observer(self):
        camera, wrist = self.devices["camera"], self.devices["wrist_ft"]
        return Observer(
            arm=self.arm,
            wrist=wrist,
            camera=camera,
            camera_model=CameraModel.from_dict(camera.describe().extra["camera"]),
            tags=setup.tags(self.resolved),
            wrist_sensor=WristSensor(np.array(wrist.describe().extra["pose"]), np.zeros(3)),
            grasp=self.resolved.grasp,
            window_ns=100_000_000,
        )

    def run(self, controller: Callable[[Plan], Controller] = OpenLoop, observer=None, **settings):
        watch = Watch(
            waypoint=self.waypoints.append,
            phase=lambda name, _: self.phases.append(name),
            event=lambda level, text: self.events.append((level, text)),
            tick=self.tick,
            felt=self.felt.append,
        )
        trial = Trial(
            "t",
            self.plan,
            controller,
            observer or self.observer(),
            self.world,
            FreeAirLoad(0.1, np.zeros(2)),
            TrialSettings(**settings),
            watch,
        )
        return trial.run()

    def tick(self):
        pass


def test_a_trial_passes_through_its_phases_in_order():
    station = Station()
    result = station.run()
    assert result.status == "completed", result.reason
    assert list(dict.fromkeys(station.phases)) == ["approach", "preload", "trajectory", "unload", "retreat", "done"]
    assert [w.step for w in station.waypoints] == list(range(STEPS))


def test_the_contact_is_unloaded_and_the_object_clear_of_the_table_at_the_end():
    station = Station()
    station.run()
    station.world.advance(0.3)
    truth = station.world.truth()
    assert truth.contacts == ()
    assert truth.wrench[:2] == pytest.approx([0.0, 0.981], abs=1e-3)  # the fingers carry the weight and nothing else


def test_the_plan_is_anchored_to_where_the_table_is_seen():
    # the tags say that the table stands 2 mm to the right of where the camera shows it
    station = Station()
    observer = station.observer()
    observer.tags["table"] = tuple(
        replace(tag, pose=(tag.pose[0] - 0.002, *tag.pose[1:])) for tag in observer.tags["table"]
    )
    result = station.run(observer=observer)
    assert result.plan.go[0] - station.plan.go[0] == pytest.approx([0.002, 0.0, 0.0], abs=1e-5)
    measured = station.waypoints[0].measured.go
    assert measured is not None and measured[:2] == pytest.approx(result.plan.go[0, :2], abs=3e-5)


def test_the_wrist_bias_is_taken_out_and_the_weight_is_not():
    station = Station()
    wrist = station.devices["wrist_ft"]
    read = wrist._read
    bias = np.array([0.3, 0.0, -0.4, 0.0, 0.02, 0.0])
    wrist._read = lambda: replace(reading := read(), wrench=reading.wrench + bias)
    station.run()
    for waypoint in station.waypoints:
        assert waypoint.measured.wrench == pytest.approx(waypoint.planned.wrench, abs=0.02)


def test_a_grasp_far_from_the_plan_is_not_started():
    station = Station("grasp.centre_mm=[0, 45]")
    observer = station.observer()
    observer.tags["go"] = tuple(replace(tag, pose=(tag.pose[0] + 0.008, *tag.pose[1:])) for tag in observer.tags["go"])
    result = station.run(observer=observer)
    assert result.status == "stopped"
    assert "8.0 mm" in result.reason and "tolerance 5 mm" in result.reason
    assert station.waypoints == []


def test_a_table_out_of_view_is_named():
    station = Station()
    observer = station.observer()
    observer.tags["table"] = ()
    result = station.run(observer=observer)
    assert result.status == "stopped" and "no tag of 'table'" in result.reason


def test_a_person_may_reset_the_scene_once():
    station = Station()
    observer = station.observer()
    hidden, observer.tags["table"] = observer.tags["table"], ()
    asked = []

    def reset(what):
        asked.append(what)
        observer.tags["table"] = hidden
        return True

    watch = Watch(reset_scene=reset)
    load_ = FreeAirLoad(0.1, np.zeros(2))
    result = Trial("t", station.plan, OpenLoop, observer, station.world, load_, TrialSettings(), watch).run()
    assert result.status == "completed" and len(asked) == 1


def test_closed_loop_takes_a_grasp_offset_out_before_touch_down():
    station = Station()
    station.devices["gripper"].release()
    station.world.reset(0, setup.scene(station.resolved).model_copy(update={"grasp": (0.001, 0.046, 0.01)}))
    station.world.advance(0.2)
    result = station.run(ClosedLoop)
    assert result.status == "completed", result.reason
    for waypoint in station.waypoints:
        go, planned = waypoint.measured.go, waypoint.planned.go
        assert go is not None and planned is not None and go[:2] == pytest.approx(planned[:2], abs=1e-4)
        assert waypoint.measured.wrench[:2] == pytest.approx(waypoint.planned.wrench[:2], abs=0.1)


@pytest.mark.parametrize("phase", ["approach", "preload", "trajectory"])
def test_a_stop_from_outside_ends_the_trial_as_stopped(phase):
    station = Station()

    def stop_in_phase():
        if station.phases[-1:] == [phase]:
            station.arm.stop()

    station.tick = stop_in_phase
    result = station.run()
    assert result.status == "stopped"
    assert "recover" in result.reason


@pytest.mark.parametrize(("fails", "status"), [(DeviceFault, "device_failed"), (CommandRefused, "stopped")])
def test_what_fails_on_the_way_out_ends_the_trial_too_and_says_what_came_before(fails, status):
    station = Station()

    def fail():
        if station.phases[-1:] == ["retreat"]:
            raise fails("wrist_ft", "read", "cable out")

    station.tick = fail
    result = station.run(force_limit=2.0)
    assert result.status == status and result.device == "wrist_ft"
    assert "exceeds the limit of 2 N; then wrist_ft: read" in result.reason


def test_a_device_that_fails_ends_the_trial_and_is_named():
    station = Station()

    def fail():
        if station.phases[-1:] == ["trajectory"]:
            raise DeviceFault("wrist_ft", "read", "cable out")

    station.tick = fail
    result = station.run()
    assert result.status == "device_failed" and "wrist_ft" in result.reason


def test_a_plant_that_diverges_ends_the_trial_as_diverged():
    station = Station()

    def sicken():
        if station.phases[-1:] == ["trajectory"]:
            station.world.plant().data.qvel[0] = np.nan

    station.tick = sicken
    result = station.run()
    assert result.status == "diverged" and "the simulated state has diverged" in result.reason
    for waypoint in station.waypoints:
        assert np.isfinite(waypoint.measured.wrench).all()


def test_a_force_beyond_the_limit_ends_the_trial_off_the_table():
    station = Station()
    result = station.run(force_limit=2.0)
    assert result.status == "stopped" and "exceeds the limit of 2 N" in result.reason
    assert station.world.truth().contacts == ()
    assert ("error", f"stopped: {result.reason}") in station.events
