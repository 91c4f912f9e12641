"""docs/add-a-device.md, followed as it stands: its package, its station file, its tests."""

from __future__ import annotations

import os
import re
import signal
import socket
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from tests.pages import ROOT, blocks, free_port

PAGE = ROOT / "docs" / "add-a-device.md"
FILES = ("pyproject.toml", "acme_cell.py", "acme_emulator.py", "bench.yaml", "test_acme_cell.py", "acme_conformance.py")
#: as they stand on the page: another program may have them here
PORT, BUS = "5005", "7450"


@pytest.fixture(scope="module")
def package(tmp_path_factory) -> Path:
    """The page's files in a folder, and beside them what `pip install` writes for their entry points."""
    folder = tmp_path_factory.mktemp("acme")
    ports = {PORT: str(free_port()), BUS: str(free_port())}
    for block in blocks(PAGE):
        if block.file:
            text = block.text
            for port, free in ports.items():
                text = text.replace(port, free)
            (folder / block.file).write_text(text)
    project = tomllib.loads((folder / "pyproject.toml").read_text())["project"]
    installed = folder / f"acme_cell-{project['version']}.dist-info"
    installed.mkdir()
    (installed / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: 0.1.0\n")
    lines = [
        line
        for group, entries in project["entry-points"].items()
        for line in (f"[{group}]", *(f"{name} = {value}" for name, value in entries.items()))
    ]
    (installed / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return folder


def start(package: Path, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, *arguments],
        cwd=package,
        env=os.environ | {"PYTHONPATH": os.pathsep.join([str(package), str(ROOT)]), "COLUMNS": "160"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def finished(package: Path, *arguments: str) -> tuple[int, str]:
    process = start(package, *arguments)
    try:
        out, err = process.communicate(timeout=100)
    finally:
        process.kill()
    return process.returncode, out + err


def extrinsic(package: Path, *arguments: str) -> tuple[int, str]:
    return finished(package, "-m", "experiments.cli", *arguments)


@contextmanager
def running(process: subprocess.Popen[str]) -> Iterator[subprocess.Popen[str]]:
    try:
        yield process
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.communicate(timeout=20)
        finally:
            process.kill()


def listening_at(port: str) -> None:
    """Wait until something does."""
    import time

    until = time.monotonic() + 20
    while time.monotonic() < until:
        try:
            socket.create_connection(("127.0.0.1", int(port)), timeout=1).close()
            return
        except ConnectionRefusedError:
            continue
    raise AssertionError(f"nothing listens at {port}")


def station(package: Path) -> dict:
    return YAML(typ="safe").load(package / "bench.yaml")


def test_the_page_has_every_file_of_the_package(package):
    assert {path.name for path in package.iterdir() if path.is_file()} == set(FILES)


def test_the_device_is_served_streams_and_passes_its_checklist(package):
    port = str(station(package)["devices"]["cell"]["port"])
    with running(start(package, "acme_emulator.py", port)):
        listening_at(port)
        with running(start(package, "-m", "experiments.cli", "serve", "bench.yaml")) as server:
            assert server.stderr is not None
            assert "serving cell" in server.stderr.readline()
            code, said = extrinsic(package, "status", "bench.yaml")
            assert code == 0, said
            [row] = [line for line in said.splitlines() if line.strip().startswith("cell")]
            assert "Acme cell" in row
            assert " yes " in row
            rates = [float(word) for word in re.findall(r"\b\d+(?:\.\d+)?\b", row)]
            assert any(80 < rate < 120 for rate in rates), row
            code, said = extrinsic(package, "check-device", "bench.yaml", "cell", "--yes")
            assert code == 0, said
        code, said = extrinsic(package, "check-device", "bench.yaml", "cell", "--yes")  # alone, now
        assert code == 0, said
        assert "alone, in this process" in said


def test_an_experiment_is_checked_on_a_station_that_has_it(package):
    lab = YAML(typ="safe").load(ROOT / "experiments" / "stations" / "example_lab.yaml")
    lab["devices"]["wrist_ft"] = station(package)["devices"]["cell"]
    with (package / "lab.yaml").open("w") as file:
        YAML().dump(lab, file)
    code, said = extrinsic(package, "check", "grasped_static", "--station", "lab.yaml")
    (package / "lab.yaml").unlink()
    assert code == 0, said


def test_a_misspelt_key_of_the_device_is_answered_with_the_nearest_of_its_own(package):
    text = (package / "bench.yaml").read_text().replace("host:", "hots:")
    (package / "wrong.yaml").write_text(text)
    code, said = extrinsic(package, "status", "wrong.yaml")
    (package / "wrong.yaml").unlink()
    assert code == 2
    assert "hots" in said
    assert "'host'" in said or "host" in said.replace("hots", "")


def test_the_contract_that_the_page_has_for_a_package_of_ones_own_is_kept(package):
    code, said = finished(package, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_acme_cell.py")
    assert code == 0, said
    assert "6 passed" in said


def test_the_whole_contract_is_held_against_it_by_name(package):
    page = PAGE.read_text()
    [command] = re.findall(r"^PYTHONPATH=\S+ pytest (.*--backend.*)$", page, re.MULTILINE)
    words = [str(ROOT / word) if word.endswith(".py") else word for word in command.split()]
    code, said = finished(package, "-m", "pytest", "-p", "no:cacheprovider", "-c", str(ROOT / "pyproject.toml"), *words)
    assert code == 0, said
    assert re.search(r"^force_torque +12 of 12$", said, re.MULTILINE), said
    assert " failed" not in said
