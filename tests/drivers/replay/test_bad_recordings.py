"""What is no recording, or not all of one: it is said what is wrong with what, and nothing hangs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
from mcap.writer import Writer
from pydantic import ValidationError

from drivers.config import REPLAYED, ReplayDevice, StationConfig
from drivers.descriptions import DESCRIPTIONS
from drivers.device_host import make
from drivers.errors import DeviceTimeout, NotConnected
from drivers.replay import Recording
from drivers.wire.log import LogWriter
from tests.drivers.replay.tape import BEGIN, DEVICES, MS, Tape, device, opened


def refusal(path: Path | str, name: str = "arm", config: dict | None = None) -> NotConnected:
    """What opening a device of a recording is refused with; describing it says the same."""
    given = {"kind": "arm", "backend": "replay", "log": str(path), **(config or {})}
    found = make(name, REPLAYED[given["kind"]].model_validate(given))
    errors = []
    for act in (found.connect, found.describe):
        with pytest.raises(NotConnected) as caught:
            act()
        errors.append(caught.value)
    assert str(errors[0]) == str(errors[1]) and errors[0].device == name and not found.connected
    return errors[0]


def test_a_path_without_a_recording_is_named(tmp_path: Path) -> None:
    assert "there is no such file or folder" in str(refusal(tmp_path / "log.mcap"))
    (tmp_path / "run").mkdir()
    error = refusal(tmp_path / "run")
    assert "there is no log in this folder" in str(error) and str(tmp_path / "run") in str(error)
    (tmp_path / "run" / "log.mcap").write_bytes(b"")
    assert "no MCAP file" in str(refusal(tmp_path / "run"))
    (tmp_path / "picture.mcap").write_bytes(b"\x89PNG\r\n\x1a\n" + bytes(100))
    assert "no MCAP file" in str(refusal(tmp_path / "picture.mcap"))


def test_a_log_of_another_tool_is_told_from_ours(tmp_path: Path) -> None:
    path = tmp_path / "other.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start(library="another tool")
        schema = writer.register_schema("foxglove.Log", "jsonschema", b"{}")
        channel = writer.register_channel("/rosout", "json", schema)
        writer.add_message(channel, 5, b"{}", 5)
        writer.finish()
    assert "another tool's log, or an empty one" in str(refusal(path))
    assert "another tool's log, or an empty one" in str(refusal(path, "rosout"))


def test_an_empty_log_has_no_devices_and_one_without_readings_ends_at_once(record, tmp_path: Path) -> None:
    with LogWriter(tmp_path / "empty.mcap"):
        pass
    assert "another tool's log, or an empty one" in str(refusal(tmp_path / "empty.mcap"))
    with opened(record(lambda tape: None)) as devices:
        devices.clock.sleep(1.0)
        with pytest.raises(DeviceTimeout, match="arm: read: the recording has ended"):
            devices["arm"].latest()
        with pytest.raises(DeviceTimeout, match="skin: capture: the recording has ended"):
            devices["skin"].capture()


def test_a_device_that_is_not_in_the_log_is_named_with_those_that_are(record) -> None:
    path = record(lambda tape: tape.pose(0, BEGIN))
    error = refusal(path, "elbow")
    assert "the log has no device 'elbow'; it has arm, hand, wrist, eye, skin" in str(error)
    assert "stream" in error.remedy
    assert "no device 'elbow'" in str(refusal(path, "arm", {"stream": "elbow"}))


def test_a_device_of_another_kind_or_at_another_place_is_refused(record) -> None:
    path = record(lambda tape: tape.pose(0, BEGIN))
    assert "'wrist' is a force_torque there, not a arm" in str(refusal(path, "arm", {"stream": "wrist"}))
    table = {"kind": "force_torque", "mount": "table"}
    assert "its mount is wrist there, not table" in str(refusal(path, "wrist", table))
    gel = {"kind": "tactile", "sensor": "gelslim", "finger": "left"}
    assert "its sensor is soft_bubble there, not gelslim" in str(refusal(path, "skin", gel))


def test_a_torn_log_plays_as_far_as_it_goes_and_says_how_it_ended(record) -> None:
    path = record(lambda tape: [tape.wrench(i, BEGIN + i * MS) for i in range(2000)])
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with opened(path) as devices:
        devices.clock.sleep(10.0)
        with pytest.raises(DeviceTimeout, match=r"the recording has ended: log.mcap is torn at byte \d+"):
            devices["wrist"].latest()


def test_damage_in_mid_file_is_left_out_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    with LogWriter(path) as log:
        tape = Tape(log)
        tape.describe(DEVICES)
        for i in range(3000):
            tape.wrench(i, BEGIN + i * MS)
            if i % 1000 == 999:
                log.drain()  # a chunk each
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 8] = bytes(8)
    path.write_bytes(data)
    with opened(path) as devices:
        devices.clock.sleep(10.0)
        assert [reading.stamp.sequence for reading in devices["wrist"].since(0)] == [*range(1000), *range(2000, 3000)]
        assert devices["wrist"].gaps == 1000
        assert "damaged at byte" in devices.recording.ending


OLD = """
experiment: {name: old}
station:
  name: lab
  world: {clock: lockstep}
  devices:
    wrist: {kind: force_torque, mount: wrist, pose: [0, 0.2, 0], rate: 500}
    skin: {kind: tactile, sensor: soft_bubble, finger: right}
"""


def old(tape: Tape) -> None:
    tape.log.add_attachment("experiment.yaml", "application/yaml", OLD.encode())
    tape.wrench(0, BEGIN)
    tape.touch(0, BEGIN)


def test_an_older_log_is_described_by_its_station_file(record) -> None:
    with opened(record(old, devices=None)) as devices:
        assert set(devices) == {"wrist", "skin"} and devices.recording.contents.lockstep
        said = devices["wrist"].describe()
        assert (said.kind, said.rate, said.frame) == ("force_torque", 500.0, "wrist")
        assert said.extra["mount"] == "wrist" and said.extra["pose"] == [0.0, 0.2, 0.0]
        assert devices["skin"].describe().extra["finger"] == "right"
        devices.clock.sleep(0.0)
        assert devices["wrist"].latest().stamp.sequence == 0 and devices["skin"].capture().stamp.sequence == 0


@pytest.mark.parametrize("text", [b"", b"[", b"station: 3\n", b"station: {name: lab}\n", b"\xff\xfe"])
def test_one_that_nobody_described_has_the_devices_whose_streams_it_has(record, text) -> None:
    def say(tape: Tape) -> None:
        tape.log.add_attachment("experiment.yaml", "application/yaml", text)
        tape.log.add_attachment(DESCRIPTIONS, "application/json", b'{"station": 3}')
        tape.pose(0, BEGIN)
        tape.tags(0, BEGIN)
        tape.touch(0, BEGIN)

    with opened(record(say, devices=None)) as devices:
        assert {name: said.describe().kind for name, said in devices.items()} == {
            "arm": "arm",
            "eye": "tag_camera",
            "skin": "tactile",
        }
        devices.clock.sleep(0.0)
        assert devices["arm"].latest().pose[1] == 0.25


def test_the_last_description_counts_that_a_log_has(record) -> None:
    def say(tape: Tape) -> None:
        tool = {"mount": "wrist", "tool": {"mass": 0.5, "centre": [0, 0.1]}}
        tape.describe({"wrist": replace(DEVICES["wrist"], extra=tool)})  # after the reset of a simulated world
        tape.wrench(0, BEGIN)

    wrist = device(Recording(record(say)), "wrist")
    assert wrist.describe().extra["tool"] == {"mass": 0.5, "centre": [0, 0.1]}


def test_what_a_stream_does_not_carry_is_damage_and_no_value(record) -> None:
    def say(tape: Tape) -> None:
        tape.pose(0, BEGIN)
        tape.put("wrist/wrench", tape.pose(1, BEGIN + MS))  # a pose on the wrench's topic

    with opened(record(say)) as devices:
        devices.clock.sleep(0.1)
        assert devices["wrist"].since(0) == [] and devices["wrist"].corrupt == 1


@pytest.mark.parametrize("speed", [-1.0, float("nan"), float("inf")])
def test_a_speed_without_meaning_is_refused(speed) -> None:
    with pytest.raises(ValueError, match="not negative"):
        Recording("run", speed=speed)
    with pytest.raises(ValidationError):
        ReplayDevice.model_validate({"backend": "replay", "log": "run", "speed": speed})


def test_a_recording_that_plays_by_itself_is_not_pushed(record) -> None:
    recording = Recording(record(lambda tape: tape.pose(0, BEGIN)), speed=0.0)
    for act in (recording.step, lambda: recording.advance_to(5), lambda: recording.seek(5)):
        with pytest.raises(ValueError, match="plays by itself"):
            act()


def test_a_station_file_with_devices_that_are_played_reads_and_writes() -> None:
    config = StationConfig.model_validate(
        {
            "name": "lab",
            "devices": {
                "arm": {"kind": "arm", "backend": "replay", "log": "runs/a", "speed": 2, "loop": True},
                "felt": {
                    "kind": "force_torque",
                    "backend": "replay",
                    "log": "runs/a/log.mcap",
                    "stream": "wrist",
                    "mount": "wrist",
                },
            },
        }
    )
    arm, felt = config.devices["arm"], config.devices["felt"]
    assert isinstance(arm, ReplayDevice) and isinstance(felt, ReplayDevice)
    assert (arm.log, arm.stream, arm.speed, arm.loop) == ("runs/a", "", 2.0, True)
    assert (felt.stream, felt.speed, felt.loop) == ("wrist", 1.0, False)
    assert getattr(felt, "mount", None) == "wrist"
    assert StationConfig.model_validate(config.model_dump(mode="json")) == config
    with pytest.raises(ValidationError):
        StationConfig.model_validate({"name": "lab", "devices": {"arm": {"kind": "arm", "backend": "replay"}}})
