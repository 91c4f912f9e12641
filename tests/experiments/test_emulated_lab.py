"""An experiment in the emulated lab: real backends, over real protocols, at a simulated plant."""

import socket

import pytest

from drivers.sim.mismatch import load_profile
from drivers.wire.log_reader import LogReader
from mechanics.catalogue import load_object
from mechanics.readings import TruthReading, WrenchReading

#: a crowded machine falls short of real time, and the run ends as one in a laboratory would
pytestmark = [pytest.mark.alone, pytest.mark.timeout(300)]


def free_port(kind):
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def at_free_ports():
    """Settings by which the lab meets no other one on this machine."""
    camera = "devices.{}.address=http://127.0.0.1:{}/stream"
    yield f"devices.wrist_ft.port={free_port(socket.SOCK_DGRAM)}"
    yield f"devices.wrist_ft.http_port={free_port(socket.SOCK_STREAM)}"
    for name in ("camera", "finger_left", "finger_right"):
        yield camera.format(name, free_port(socket.SOCK_STREAM))
    yield "devices.arm.host=127.0.0.77"


@pytest.fixture(scope="module")
def done(shared_command):
    sets = [word for text in at_free_ports() for word in ("--set", text)]
    few = ("--set", "stages.0.parameters.steps=6")  # all twenty take two minutes of real time
    process = shared_command.start_run("grasped_static", "--station", "emulated_lab", *few, *sets)
    return shared_command.finish(process, timeout=240)


def test_the_experiment_completes_with_errors_like_any_runs(done):
    assert done.code == 0, done.err
    results = done.results
    assert [trial["status"] for trial in results["trials"]] == ["completed", "completed"]
    open_loop, closed_loop = done.trial("open_loop"), done.trial("closed_loop")
    for trial in results["trials"]:
        for witness in ("measured", "truth"):
            assert 0 < trial[witness]["go_pose_mm"]["mean"] < 5
            assert 0 < trial[witness]["wrench_N"]["mean"] < 5
    # a law that sees the object's tag through the MJPEG camera undoes what the arm's bias did
    assert closed_loop["truth"]["go_pose_mm"]["mean"] < open_loop["truth"]["go_pose_mm"]["mean"] / 2


def test_what_the_box_sent_is_what_hangs_on_the_wrist(done):
    """Through RDT, in the sensor's frame: tool and box, before anything is touched."""
    topics = ["emulated_lab/world/truth", "emulated_lab/wrist_ft/wrench"]
    values = (value for _, value in LogReader(done.folder / "log.mcap").values(topics))
    laid_out = next(value for value in values if isinstance(value, TruthReading)).stamp.capture_ns + 200_000_000
    first = next(v for v in values if isinstance(v, WrenchReading) and v.stamp.capture_ns > laid_out)
    weight = (load_profile("lab").force_torque.tool_mass + load_object("tall_box").mass) * 9.81
    assert first.wrench[2] == pytest.approx(-weight, abs=1.0)  # an untared sensor has a bias


def test_every_stream_of_the_station_is_in_the_log(done):
    counts = LogReader(done.folder / "log.mcap").counts()
    for stream in ("arm/pose", "wrist_ft/wrench", "camera/detections", "finger_left/image", "finger_right/image"):
        assert counts.get(f"emulated_lab/{stream}", 0) > 20, stream


def test_the_log_replayed_gives_the_same_estimates(done, shared_command):
    replayed = shared_command.finish(shared_command.start("replay", str(done.folder), "--check"))
    assert replayed.code == 0, replayed.err
    assert "0 differ" in replayed.out
