"""docs/deploy.md: its example station, its keys, its services, its commands."""

from __future__ import annotations

import re
import shlex
from configparser import RawConfigParser
from pathlib import Path
from typing import Any

import pytest
import typer

from experiments.check_device.checklist import STEPS
from experiments.check_device.stream import STREAM
from experiments.cli import app
from experiments.files import load_station

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "deploy.md").read_text()
SERVICES = sorted((ROOT / "docs" / "deploy").glob("*.service"))


def commands() -> list[list[str]]:
    """Every `extrinsic ...` of the page's shell blocks, without its comment."""
    blocks = re.findall(r"^```sh\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    lines = [line for block in blocks for line in block.splitlines()]
    found = [shlex.split(line, comments=True) for line in lines if line.startswith("extrinsic ")]
    assert len(found) > 10
    return found


def test_the_example_lab_is_accepted(command):
    finished = command.finish(command.start("check", "grasped_static", "--station", "example_lab"))
    assert finished.code == 0, finished.err
    assert "nothing was started" in finished.out


def test_the_example_lab_is_real_throughout_and_meets_at_a_router_with_keys():
    config = load_station("example_lab")
    assert {device.backend for device in config.devices.values()} == {"real"}
    assert {device.kind for device in config.devices.values()} == set(STEPS)
    assert config.world is None
    assert config.bus.mode == "client"
    assert config.bus.tls is not None
    assert config.bus.endpoint.startswith("tls/")


def test_its_machines_serve_every_device_once():
    served = [words[3:] for words in commands() if words[:3] == ["extrinsic", "serve", "example_lab"]]
    devices = [device for machine in served for device in machine]
    assert sorted(devices) == sorted(load_station("example_lab").devices)


def test_its_keys_are_made_as_the_page_says(command):
    [init] = [words for words in commands() if words[1:3] == ["lab", "init"]]
    finished = command.finish(command.start(*init[1:]))
    assert finished.code == 0, finished.err
    members = {path.name for path in (command.folder / "lab").iterdir() if path.is_dir()}
    assert members == {"ca", "router", "device-bench", "device-shelf", "runner-alice", "viewer-wall"}
    for member in re.findall(r"`lab/([\w-]+)`", PAGE):
        assert member in members


def followed(words: list[str]) -> tuple[Any, list[str]]:
    """The command that ``words`` name, and what is left for it."""
    found: Any = typer.main.get_command(app)
    while hasattr(found, "commands"):
        found, words = found.commands[words[0]], words[1:]
    return found, words


@pytest.mark.parametrize("words", commands(), ids=" ".join)
def test_every_command_of_the_page_is_one(words):
    found, rest = followed(words[1:])
    with found.make_context("extrinsic", list(rest)):  # refuses an option that is none, and an argument too many
        pass


def test_the_page_names_every_step_of_every_kind():
    rows = {row[0]: row[1] for row in re.findall(r"^\| `(\w+)` \| (.*) \|$", PAGE, re.MULTILINE)}
    for kind, steps in STEPS.items():
        for step in steps:
            assert f"`{step.name}`" in rows[kind], (kind, step.name)
    for step in STREAM:
        assert f"`{step.name}`" in PAGE


@pytest.mark.parametrize("service", SERVICES, ids=lambda path: path.stem)
def test_a_service_starts_a_command_that_there_is_and_ends_it_in_order(service):
    unit = RawConfigParser(strict=False, allow_no_value=True)
    unit.optionxform = str  # pyright: ignore[reportAttributeAccessIssue]
    unit.read(service)
    given = unit["Service"]
    program, *words = shlex.split(given["ExecStart"])
    assert Path(program).name == "extrinsic"
    _, rest = followed(words)
    assert rest[0] == "${STATION}"
    assert given["KillSignal"] == "SIGTERM"
    assert given["Restart"] == "on-failure"
    assert given["RestartPreventExitStatus"] == "2"  # bad input: it would fail again
    assert given["NoNewPrivileges"] == "yes"
    assert given["User"] != "root"
