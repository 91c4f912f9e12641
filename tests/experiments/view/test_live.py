"""A station that somebody looks on at while a run works there."""

import signal

import pytest

from tests.experiments.view.test_recorded import SHORT, Saved

pytest.importorskip("rerun", reason="rerun-sdk is not installed")


@pytest.mark.timeout(240)
def test_a_run_is_seen_as_it_happens_and_ctrl_c_saves_what_was_seen(command):
    at = ("--set", f"bus.endpoint={command.endpoint}")
    host = command.start("serve", "sim", *at)
    assert host.stderr is not None and "serving" in host.stderr.readline()
    view = command.start("view", "sim", *at, "--save", "live.rrd")
    assert view.stderr is not None and "looking on at sim" in view.stderr.readline()
    finished = command.run("grasped_static", *SHORT, "--set", "stages.1.controllers=[open_loop]")
    assert finished.code == 0, finished.err
    assert "sim is on show" in view.stderr.readline()
    view.send_signal(signal.SIGINT)
    assert view.wait(30) == 0
    assert host.poll() is None  # who looks on ends nothing
    saved = Saved(command.folder / "live.rrd")
    seen = saved.rows("/station/scene/plane/truth/go", "Transform3D:translation", "station_time")
    # views: of 50 a second of the station's time, at most 20 a second of ours
    assert 0 < len(seen) <= finished.results["log"]["messages"]["sim/world/truth"]
    assert {"/station/scene/plane/truth/go/outline", "/station/sensors/wrist_ft/force"} <= saved.paths
    assert saved.reader.blueprints()
