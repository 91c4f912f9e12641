"""The backends that the device contract is held against, and the table of how they fared.

A backend is one entry of `BACKENDS`: a context manager that yields a `Lab` whose devices are open. A claim is held
against every backend, or against those that it names: ``@pytest.mark.backends(*SIMULATED)``. With ``--backend`` it is
another package's, which is held to what a real one is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from importlib import import_module
from typing import cast

import pytest

from drivers.config import StationConfig
from experiments.ports import free_endpoint
from tests.conformance import emulated, recorded
from tests.conformance.lab import Lab
from tests.conformance.simulated import SCENE, SIMULATED, station

Backend = Callable[[], AbstractContextManager[Lab]]


def simulated(open_station: Callable[[StationConfig], AbstractContextManager[Lab]]) -> AbstractContextManager[Lab]:
    """A simulated station, opened in one way or the other."""
    return open_station(station())


BACKENDS: dict[str, Backend] = {
    **{name: partial(simulated, opened) for name, opened in SIMULATED.items()},
    "real": emulated.in_process,
    "real over zenoh": emulated.over_zenoh,
    "replay": recorded.in_process,
    "replay over zenoh": recorded.over_zenoh,
}


#: what says little that the others do not say, and takes its time
SLOW = ("replay over zenoh",)


def pytest_addoption(parser: pytest.Parser) -> None:
    what = "hold this backend against the contract instead of ours: a context manager that yields a Lab"
    parser.addoption("--backend", action="append", default=[], metavar="NAME=MODULE:FUNCTION", help=what)


def pytest_configure(config: pytest.Config) -> None:
    foreign: dict[str, Backend] = {}
    for text in config.getoption("--backend") or ():
        name, is_named, where = text.partition("=")
        module, is_placed, function = where.partition(":")
        if not (is_named and is_placed):
            raise pytest.UsageError(f"--backend {text}: expected NAME=MODULE:FUNCTION")
        try:
            foreign[name] = getattr(import_module(module), function)
        except (ImportError, AttributeError) as error:
            raise pytest.UsageError(f"--backend {text}: {error}") from error
    if foreign:
        BACKENDS.clear()
        BACKENDS.update(foreign)


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    if "opened" not in metafunc.fixturenames:
        return
    mark = metafunc.definition.get_closest_marker("backends")
    named = list(BACKENDS if mark is None else mark.args)
    if metafunc.config.getoption("--backend"):  # another package's is a real one
        named = list(BACKENDS if mark is None or "real" in mark.args else ())
    backends = [pytest.param(name, marks=[pytest.mark.slow] if name in SLOW else []) for name in named]
    metafunc.parametrize("opened", backends, indirect=True, scope="module")


@pytest.fixture(scope="module")
def opened(request: pytest.FixtureRequest) -> Iterator[Lab]:
    """The backend's station, open for the whole module."""
    with BACKENDS[request.param]() as lab:
        yield lab


@pytest.fixture
def lab(opened: Lab) -> Lab:
    """The station as new: every device open, the arm free, a world at its start."""
    opened.renew()
    for device in opened.devices.values():
        device.connect()
    if "arm" not in opened.names:
        return opened
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
