"""What `extrinsic view` is asked that cannot be: each with what to do, and exit code 2 or 3."""

import json
import os
import select
import socket
import subprocess
import sys

import pytest
from typer.testing import CliRunner

from drivers.config import StationConfig
from drivers.errors import NotConnected
from drivers.onlooker import Onlooker
from drivers.wire.bus import Bus
from experiments.cli import app
from experiments.files import load_station
from experiments.ports import free_endpoint
from experiments.view import package, page, viewer


def view(*arguments):
    result = CliRunner().invoke(app, ["view", *map(str, arguments)])
    return result.exit_code, result.output


def test_without_rerun_it_says_how_to_install_it(monkeypatch, tmp_path):
    monkeypatch.setattr(package, "find_spec", lambda name: None)
    code, said = view(tmp_path)
    assert code == 2 and "pip install 'extrinsic[view]'" in said


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((), "RUN | STATION"),
        (("sim", "--web", "--save", "x.rrd"), "--save"),
        (("sim", "--port", "9000"), "--port"),
        (("sim", "--no-browser"), "--no-browser"),
        ((".", "--seconds", "3"), "--seconds"),
        ((".", "--set", "seed=1"), "--set"),
        (("nowhere",), "there is no such run folder, and no such station"),
        (("nowhere.mcap",), "there is no such file"),
        ((".",), "no experiment.yaml in it"),
    ],
)
def test_what_does_not_go_together_is_refused_by_name(arguments, told, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    code, said = view(*arguments)
    assert code == 2 and told in said


def test_a_station_that_is_not_there_is_a_clear_error(tmp_path):
    code, said = view("sim", "--set", f"bus.endpoint={free_endpoint()}", "--save", tmp_path / "x.rrd")
    assert code == 3 and "nothing listens there" in said and "extrinsic serve" in said
    assert not (tmp_path / "x.rrd").exists()


def test_something_else_at_the_endpoint_is_an_error_once_the_time_is_over():
    endpoint = free_endpoint()
    config: StationConfig = load_station("sim", [f"bus.endpoint={endpoint}"])
    with Bus(endpoint, listen=True), pytest.raises(NotConnected, match="does not serve station 'sim'"):
        Onlooker(config, timeout=0.3).__enter__()


def test_a_port_that_is_taken_is_refused():
    with socket.socket() as other, pytest.raises(Exception, match="--port"):
        other.bind(("127.0.0.1", 0))
        other.listen()
        page.Page(other.getsockname()[1], 1, 2)


def test_the_first_page_goes_out_without_links_to_elsewhere():
    shipped = (
        '<html><head lang="en"><link rel="icon" href="favicon.ico" />\n'
        '<link rel="preconnect" href="https://fonts.gstatic.com" crossorigin />\n<link\n'
        '  href="https://fonts.googleapis.com/css2?family=Inter:wght@100;500&display=swap"\n  rel="stylesheet"\n/>'
        '<script src="re_viewer.js"></script></head></html>'
    )
    told = page.tamed(shipped)
    assert "fonts" not in told and "favicon.ico" in told
    assert told.index("window.fetch = ") < told.index("re_viewer.js")


def test_the_policy_names_this_machine_only():
    sources = {word for part in page.policy(4711).split(";") for word in part.split()[1:]}
    assert {word for word in sources if "://" in word} == {"http://127.0.0.1:4711", "http://localhost:4711"}


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the kernel has no such signal")
def test_the_viewer_ends_with_who_started_it_even_where_that_is_killed():
    held, kept = os.pipe()  # the program holds the writing end, and tells through it when it is there
    there = f"import os, signal; os.write({kept}, b'x'); signal.pause()"
    program = [*viewer.BOUND, sys.executable, "-c", there]
    script = f"import subprocess, sys; subprocess.Popen({program!r}, pass_fds=[{kept}]); sys.stdin.read()"
    owner = subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE, pass_fds=[kept])
    os.close(kept)
    try:
        assert select.select([held], [], [], 30)[0] and os.read(held, 1) == b"x"
    finally:
        owner.kill()
        owner.communicate(timeout=10)
    assert select.select([held], [], [], 30)[0] and os.read(held, 1) == b""  # nobody holds it any more
    os.close(held)


def test_the_viewers_reports_are_off_and_the_users_settings_are_not_touched(monkeypatch, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    home = tmp_path / "home"
    home.mkdir()
    monkeypatch.setenv("HOME", str(home))
    monkeypatch.setenv("FORCE_RERUN_ANALYTICS", "1")
    environment = viewer.quiet(tmp_path / "own")
    assert environment["CI"] and "FORCE_RERUN_ANALYTICS" not in environment
    viewer.switch_off(package.viewer(), environment)
    shown = subprocess.run(
        [package.viewer(), "analytics", "config"], env=environment, capture_output=True, timeout=30, check=True
    )
    assert json.loads(shown.stdout)["analytics_enabled"] is False
    assert not list(home.rglob("*"))
    assert not list((tmp_path / "own").rglob("analytics/*.json"))  # nothing waits to be sent
