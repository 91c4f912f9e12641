"""The backends that the device contract is held against, and the table of how they fared.

A backend is one entry of `BACKENDS`: a context manager that yields a `Lab` whose devices are open. A claim is held
against every backend, or against those that it names: ``@pytest.mark.backends(*SIMULATED)``.
"""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from functools import partial
from typing import cast

import pytest

from drivers.config import (
    ArmConfig,
    BusConfig,
    ForceTorqueConfig,
    GripperConfig,
    StationConfig,
    TactileConfig,
    TagCameraConfig,
    WorldConfig,
)
from drivers.scene import Body, Scene, TagMount
from drivers.sim.soft_bubble import view_of
from drivers.sim.world import World
from drivers.station import Station
from tests.conformance import emulated
from tests.conformance.lab import Lab, losing_readings, losing_samples

START = (0.0, 0.25, 0.1)

SCENE = Scene(
    grasped=Body(
        name="tall_box",
        vertices=((-0.025, -0.07345), (0.025, -0.07345), (0.025, 0.07345), (-0.025, 0.07345)),
        mass=0.1,
        tag=TagMount(id=3, size=0.036, pose=(0.0, -0.04, 0.0), height=0.01),  # below the fingers
    ),
    grasp=(0.0, 0.045, 0.0),
    stiffness=((2209.0, 0.0, 0.0), (0.0, 1876.0, 0.0), (0.0, 0.0, 3.2)),
    friction={"go-ground": 0.33},
    start=START,
).model_dump(mode="json")


@contextmanager
def in_process(config: StationConfig) -> Iterator[Lab]:
    """The simulated devices themselves; a second client shares them."""
    world = World(config)

    @contextmanager
    def join() -> Iterator[Lab]:
        yield lab

    lab = Lab(world.devices, world, world, join, losing_readings)
    for device in world.devices.values():
        device.connect()
    yield lab
    for device in world.devices.values():
        device.close()


@contextmanager
def over_zenoh(config: StationConfig) -> Iterator[Lab]:
    """The simulated devices in a host process, over the bus; a second client is a second session."""
    with Station(config).connect() as devices:
        assert devices.simulation is not None
        yield Lab(devices, devices.clock, devices.simulation, lambda: over_zenoh(config), losing_samples)


SIMULATED: dict[str, Callable[[StationConfig], AbstractContextManager[Lab]]] = {
    "sim in process": in_process,
    "sim over zenoh": over_zenoh,
}


@contextmanager
def simulated(open_station: Callable[[StationConfig], AbstractContextManager[Lab]]) -> Iterator[Lab]:
    """A simulated station with a device of every kind."""
    config = StationConfig(
        name="bench",
        world=WorldConfig(),
        bus=BusConfig(endpoint=free_endpoint()),
        devices={
            "arm": ArmConfig(kind="arm"),
            "gripper": GripperConfig(kind="gripper"),
            "wrist_ft": ForceTorqueConfig(kind="force_torque", mount="wrist"),
            "camera": TagCameraConfig(
                kind="tag_camera", width=640, height=480, focal=600.0, position=(0, -0.5, 0.2), look_at=(0, 0, 0.2)
            ),
            "bubble": TactileConfig(kind="tactile", sensor="soft_bubble", finger="left", indentation=0.016),
            "gel": TactileConfig(kind="tactile", sensor="gelslim", finger="right", width=160, height=120),
        },
    )
    bubble = config.devices["bubble"]
    assert isinstance(bubble, TactileConfig)
    view_of(bubble)  # compiled once per installation, which takes longer than a frame may
    with open_station(config) as lab:
        yield lab


BACKENDS: dict[str, Callable[[], AbstractContextManager[Lab]]] = {
    **{name: partial(simulated, opened) for name, opened in SIMULATED.items()},
    "real": emulated.in_process,
    "real over zenoh": emulated.over_zenoh,
}


def free_endpoint() -> str:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "opened" in metafunc.fixturenames:
        mark = metafunc.definition.get_closest_marker("backends")
        metafunc.parametrize("opened", list(BACKENDS if mark is None else mark.args), indirect=True, scope="module")


@pytest.fixture(scope="module")
def opened(request: pytest.FixtureRequest) -> Iterator[Lab]:
    """The backend's station, open for the whole module."""
    with BACKENDS[request.param]() as lab:
        yield lab


@pytest.fixture
def lab(opened: Lab) -> Lab:
    """The station as new: every device open, the arm free, a world at its start."""
    for device in opened.devices.values():
        device.connect()
    arm = opened.of("arm")
    arm.release()
    arm.recover()
    if opened.simulation is not None:
        opened.simulation.reset(0, SCENE)
    return opened


@pytest.fixture(params=list(SIMULATED))
def backend(request: pytest.FixtureRequest) -> Callable[[StationConfig], AbstractContextManager[Lab]]:
    """The way to open a simulated station of one's own, to be broken."""
    return SIMULATED[request.param]


@pytest.fixture
def endpoint() -> str:
    """An endpoint that nobody uses."""
    return free_endpoint()


@pytest.fixture
def scene() -> dict:
    """The scene that `lab` starts with."""
    return SCENE


# -- the table ---------------------------------------------------------------------------------------------------------

_OUTCOMES: dict[tuple[str, str], list[bool]] = {}


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo) -> Iterator[None]:
    outcome = yield
    report = outcome.get_result()  # pyright: ignore[reportAttributeAccessIssue]
    callspec = getattr(item, "callspec", None)
    params = {} if callspec is None else callspec.params
    backend = params.get("opened") or params.get("backend")
    if backend is None or (report.when != "call" and report.passed):
        return
    kind = params.get("kind") or getattr(getattr(item, "function", None), "kind", "station")
    if "fault" in params:
        kind = f"fault {params['fault']}"
    report.user_properties.append(("conformance", (kind, backend)))


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    # reports come here from every worker; a worker's own table would be seen by nobody
    for name, cell in report.user_properties:
        if name == "conformance" and (report.when == "call" or not report.passed):
            kind, backend = cast("tuple[str, str]", cell)
            _OUTCOMES.setdefault((kind, backend), []).append(report.passed)


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    if not _OUTCOMES:
        return
    kinds = sorted({kind for kind, _ in _OUTCOMES})
    terminalreporter.section("device conformance: claims that hold")
    terminalreporter.write_line(f"{'':16}" + "".join(f"{backend:>20}" for backend in BACKENDS))
    for kind in kinds:
        cells = [_OUTCOMES.get((kind, backend)) for backend in BACKENDS]
        texts = ["-" if cell is None else f"{sum(cell)} of {len(cell)}" for cell in cells]
        terminalreporter.write_line(f"{kind:16}" + "".join(f"{text:>20}" for text in texts))
