"""`extrinsic bench sim`: how fast the simulated station is, and what each sensor costs."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from rich.console import Console

from drivers.config import DeviceConfig, StationConfig, TactileConfig, TagCameraConfig
from drivers.interfaces import Arm, ArmTarget, ImagingSensor
from drivers.scene import Scene
from drivers.sim.plant import Plant
from drivers.sim.world import World
from drivers.station import Station
from experiments import runner, setup
from experiments.bench.figures import Figure, figure_of, in_parts, median_of, seconds
from experiments.files import Resolved, load
from experiments.ports import free_endpoint
from experiments.progress import Heard, unheard
from mechanics import se2

X_REAL = "× real time"
#: what a renderer may take to compile, once after an installation [s]
COMPILING = 120.0
#: how far the arm presses beyond touch [m]
PRESS = 1e-3


def run(runs: int = 5, heard: Heard = unheard) -> Iterator[Figure]:
    """Measure everything, figure by figure."""
    resolved = load("grasped_static", None, [f"bus.endpoint={free_endpoint()}"])
    kinds = ("arm", "force_torque", "gripper")
    yield from in_parts(
        [
            (3, lambda: [_plant_alone(resolved, runs)]),
            (1, lambda: [_world("plant, arm and two force/torque sensors", resolved, kinds, runs)]),
            (4, lambda: _frames(resolved, runs)),
            (4 * runs, lambda: [_everything(resolved, runs)]),
            (25 * max(2, runs // 2), lambda: [_trial(resolved, max(2, runs // 2))]),
        ],
        heard,
    )


def _touching(resolved: Resolved) -> Scene:
    """The go tilted by 15° in the fingers, its corner 0.1 mm above the ground."""
    scene = setup.scene(resolved)
    x, y, _ = scene.start
    tilted = scene.model_copy(update={"start": (x, y, np.radians(15.0))})
    go = Plant(tilted).go
    lowest = float((se2.transform(go, np.array(scene.grasped.vertices)))[:, 1].min())
    return tilted.model_copy(update={"start": (x, y - lowest + 1e-4, np.radians(15.0))})


def _plant_alone(resolved: Resolved, runs: int) -> Figure:
    scene = _touching(resolved)
    plant, steps = Plant(scene), round(1.0 / 0.001)
    x, y, theta = scene.start

    def second() -> None:
        for _ in range(steps):
            plant.step((x, y - PRESS, theta), (0.0, 0.0, 0.0))

    what = "the go pressed on the ground, 1 ms steps, no device"
    return median_of("plant alone", lambda: 1.0 / seconds(second), X_REAL, runs, what)


def _pressed(config: StationConfig, resolved: Resolved) -> World:
    """A world in which the go stands on its corner, pressed on the ground by a millimetre of the arm's motion."""
    world = World(config)
    for device in world.devices.values():
        device.connect()
    scene = _touching(resolved)
    world.reset(0, scene)
    arm = next(device for device in world.devices.values() if isinstance(device, Arm))
    arm.acquire("bench")
    down = np.array(scene.start) - (0.0, PRESS, 0.0)
    arm.command(ArmTarget(down, np.zeros(3), 0.2))
    world.advance(0.5)
    return world


def _world(name: str, resolved: Resolved, kinds: tuple[str, ...], runs: int) -> Figure:
    station = resolved.station
    devices = {key: device for key, device in station.devices.items() if device.kind in kinds}
    world = _pressed(station.model_copy(update={"devices": devices}), resolved)
    return median_of(name, lambda: 1.0 / seconds(lambda: world.advance(1.0)), X_REAL, runs)


def _frames(resolved: Resolved, runs: int) -> Iterator[Figure]:
    """What a frame of each imaging sensor costs, the go moving a little from frame to frame as it does in a trial."""
    camera = next(d for d in resolved.station.devices.values() if isinstance(d, TagCameraConfig))
    wanted = {
        "bubble frame 224×171": TactileConfig(kind="tactile", sensor="soft_bubble", finger="left"),
        "bubble frame 640×480": TactileConfig(
            kind="tactile", sensor="soft_bubble", finger="left", width=640, height=480
        ),
        "gel frame 320×240": TactileConfig(kind="tactile", sensor="gelslim", finger="left", width=320, height=240),
        "tag image, rendered and detected": camera,
    }
    for name, config in wanted.items():
        yield figure_of(name, frame_times(resolved, config, max(10, 4 * runs)), "ms")


def frame_times(resolved: Resolved, config: DeviceConfig, frames: int) -> list[float]:
    """What each of so many ``frames`` of an imaging sensor costs [ms], the go pressed on the ground and moving."""
    arm = {key: device for key, device in resolved.station.devices.items() if device.kind == "arm"}
    world = _pressed(resolved.station.model_copy(update={"devices": {**arm, "sensor": config}}), resolved)
    sensor = world.devices["sensor"]
    assert isinstance(sensor, ImagingSensor)
    for _ in range(3):
        sensor.capture(COMPILING)  # imports, compilation, the first solution
    times = []
    for _ in range(frames):
        world.advance(1 / 30)
        times.append(1e3 * seconds(sensor.capture))
    return times


def _everything(resolved: Resolved, runs: int) -> Figure:
    """All sensors of the station at their rates, over the bus from a host process, received here."""
    station = resolved.station
    rates = {name: device.rate for name, device in station.devices.items() if device.kind in ("tactile", "tag_camera")}
    ratios = []
    with _open(resolved) as devices:
        images = {name: devices[name] for name in rates}
        base = max(rates.values())
        for _ in range(runs):
            begin, frames = time.perf_counter(), round(base)
            for frame in range(frames):
                devices.clock.sleep(1 / base)
                for name, sensor in images.items():
                    assert isinstance(sensor, ImagingSensor)
                    if (frame * rates[name]) % base < rates[name]:
                        sensor.capture()
            ratios.append(1.0 / (time.perf_counter() - begin))
    what = ", ".join(f"{name} at {rate:g} Hz" for name, rate in rates.items())
    return figure_of("whole station, every sensor streaming", ratios, X_REAL, what)


@contextmanager
def _open(resolved: Resolved) -> Iterator:
    with Station(resolved.station).connect() as devices:
        assert devices.simulation is not None and isinstance(devices.arm, Arm)
        devices.simulation.reset(0, setup.scene(resolved).model_dump())
        devices.clock.sleep(0.1)
        yield devices


def _trial(resolved: Resolved, runs: int) -> Figure:
    """A whole open-loop trial as `extrinsic run` runs it, logged: simulated time over the stage's wall time."""
    ratios = []
    with tempfile.TemporaryDirectory() as folder:
        for i in range(runs):
            sets = [f"bus.endpoint={free_endpoint()}", "stages.1.controllers=[open_loop]"]
            outcome = runner.run(
                load("grasped_static", None, sets), Path(folder) / str(i), Console(quiet=True, stderr=True)
            )
            timing = outcome.results["timing"]
            ratios.append(timing["execute_station_s"] / timing["execute_wall_s"])
    return figure_of("trial in lockstep, images on demand", ratios, X_REAL, "grasped static, open loop, logged")
