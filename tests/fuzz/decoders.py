"""Every decoder that meets bytes from outside: valid inputs to begin from, how it is called, what it may raise."""

from __future__ import annotations

import csv
import functools
import io
import json
import os
import shutil
import struct
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from mcap.writer import CompressionType, Writer
from pydantic import BaseModel

import experiments
from drivers.config import StationConfig
from drivers.errors import DriverError, NotConnected, ProtocolError
from drivers.real.netft_setup import HttpError, SetupError
from drivers.sim.mismatch import FOLDER as PROFILES
from drivers.sim.mismatch import Mismatch
from drivers.wire import messages
from drivers.wire.codec import encode_reading
from drivers.wire.log import LogWriter
from drivers.wire.log_reader import LogReader
from drivers.wire.log_repair import repair_log
from experiments import files
from experiments.calibrate import store
from experiments.calibrate.models import (
    CameraCalibration,
    ClockCalibration,
    Delay,
    ElasticityCalibration,
    ForceTorqueCalibration,
    FrictionCalibration,
    Origin,
    TagCalibration,
)
from experiments.calibrate.samples import load_samples
from experiments.campaign.frame import cells, trials_frame
from experiments.report.collect import collect, plan_of
from experiments.report.logged import LoggedTrial
from experiments.report.page import render
from experiments.run_folder import RunFolder
from experiments.schema import Experiment
from experiments.table.schema import Table
from mechanics.camera import CameraModel
from mechanics.catalogue import CATALOGUE, SENSORS, ObjectModel, SensorModel
from mechanics.readings import (
    Stamp,
    WrenchReading,
)
from mechanics.records import EventRecord, TrialRecord
from mechanics.yaml_input import InputError, parse, read_yaml
from planning import plan_file
from planning.plan import Plan
from planning.plan_file import PlanFileError
from tests.fuzz import franka, mjpeg, netft, on_the_bus

PACKAGE = Path(experiments.__file__).parent


@dataclass(frozen=True)
class Decoder:
    """``decode`` takes any bytes and returns, or raises one of ``errors``: nothing else, ever."""

    seeds: Callable[[], list[bytes]]
    decode: Callable[[bytes], Any]
    errors: tuple[type[Exception], ...]
    tokens: tuple[bytes, ...] = field(default=())


@functools.cache
def _scratch() -> Path:
    """A folder in memory, where there is one: the disk is not what is tried."""
    memory = Path("/dev/shm")
    for left in memory.glob("fuzz-*-*"):  # libFuzzer ends without cleaning up
        if not Path("/proc", left.name.split("-")[1]).exists():
            shutil.rmtree(left, ignore_errors=True)
    folder = tempfile.TemporaryDirectory(prefix=f"fuzz-{os.getpid()}-", dir=memory if memory.is_dir() else None)
    _KEPT.append(folder)
    return Path(folder.name)


_KEPT: list[tempfile.TemporaryDirectory] = []


def _written(name: str, data: bytes) -> Path:
    file = _scratch() / name
    file.write_bytes(data)
    return file


# -- YAML --------------------------------------------------------------------------------------------------------------


def _decode_yaml(data: bytes) -> None:
    read_yaml(_written("any.yaml", data))


def _yaml_seeds() -> list[bytes]:
    texts = [file.read_bytes() for file in (PACKAGE / "grasped_static.yaml", PACKAGE / "stations" / "sim.yaml")]
    return [*texts, b"a: &x [1, 2.5e-3, true, null]\nb: *x\nc: {d: 'e', \"f\": g}\nh: |\n  text\n", b"a: [b, {c: d}]\n"]


MODELS: tuple[tuple[type[BaseModel], Path], ...] = (
    (StationConfig, PACKAGE / "stations"),
    (ObjectModel, CATALOGUE),
    (SensorModel, SENSORS),
    (Mismatch, PROFILES),
    (Table, PACKAGE),
)


def _models() -> list[bytes]:
    found: list[bytes] = []
    for i, (model, place) in enumerate(MODELS):
        pattern = "table_*.yaml" if model is Table else "*.yaml"
        smallest = sorted(place.glob(pattern), key=lambda path: path.stat().st_size)[:2]
        found += [bytes([i]) + path.read_bytes() for path in smallest]
    return found


def _decode_model(data: bytes) -> None:
    if data:
        model = MODELS[data[0] % len(MODELS)][0]
        parse(model, read_yaml(_written("model.yaml", data[1:])))


def _experiments() -> list[bytes]:
    names = ("grasped_static", "extrinsic_pushing", "demo")
    return [(PACKAGE / f"{name}.yaml").read_bytes() for name in names]


def _decode_experiment(data: bytes) -> None:
    parse(Experiment, read_yaml(_written("experiment.yaml", data)))


_read_once = functools.lru_cache(maxsize=50)(read_yaml)


def _decode_loaded(data: bytes) -> None:
    file = _written("loaded.yaml", data)
    with patch.object(files, "read_yaml", lambda path: read_yaml(path) if path == file else _read_once(path)):
        files.load(str(file))


def _sets() -> list[bytes]:
    return [
        b"world.profile=lab\ntrial.ramp=0.3",
        b"stages.0.parameters.tangential=[1, 1]\nfriction={go-ground: 0.1}",
        b"station.world.friction_scale={go-ground: 1.2}\nseed=4\nbus.endpoint=tcp/127.0.0.1:7447",
        b"station=sim\nexperiment.seed=3\nstages.1.controllers.0=open_loop",
        b"calibration.source=none\ngrasp.centre_mm=[0, 20]\ndevices.arm.rate=50",
    ]


def _decode_sets(data: bytes) -> None:
    text = data.decode("utf-8", errors="surrogateescape")  # as the command line gives it
    with patch.object(files, "read_yaml", _read_once):  # the shipped files are not what is tried
        files.load("grasped_static", sets=text.split("\n")[:8])


# -- files of the project's own ----------------------------------------------------------------------------------------


def _calibrations() -> list[bytes]:
    k = ((2500.0, -100.0, 10.0), (-100.0, 2000.0, -12.0), (10.0, -12.0, 3.0))
    zero = (0.0, 0.0, 0.0)
    origin = Origin(
        made=datetime(2026, 1, 2, tzinfo=UTC),
        station="sim",
        world={"profile": "lab", "seed": 0, "stiffness_scale": 1.0},
        devices={"arm": "sim"},
        objects={"go": "tall_box 1234abcd", "eo": "hbox 00000001"},
    )
    camera = CameraModel.looking_at((0.0, -1.0, 0.2), (0.0, 0.0, 0.1), 1400.0, 1280, 720)
    made = [
        ElasticityCalibration(
            origin=origin, sensor="soft_bubble", stiffness=k, deviation=(zero, zero, zero), amplitude=0.002, initial=k,
            offset=zero, residual=zero, chi2=1.0, method="m", samples=20,
        ),
        FrictionCalibration(origin=origin, pair="go-ground", mu=0.4, interval=(0.3, 0.5), samples=50),
        ForceTorqueCalibration(
            origin=origin, device="ft", tool_mass=0.5, tool_centre=(0.0, 0.1), deviation=zero, residual=0.1, samples=9
        ),
        TagCalibration(origin=origin, id=3, pose=zero, deviation=zero),
        CameraCalibration(
            origin=origin, device="camera", camera=camera.as_dict(), focal_deviation=1.0, residual_px=0.2, views=9
        ),
        ClockCalibration(origin=origin, delays={"wrist_ft": Delay(delay=0.01, deviation=0.001)}),
    ]  # fmt: skip
    return [store.dumped(calibration).encode() for calibration in made]


def _decode_calibration(data: bytes) -> None:
    """Read it, and ask what every user of a calibration asks."""
    found = store.read(_written("calibration.yaml", data))
    known = store.Calibrations()
    known.add(found, Path("calibration.yaml"))
    json.dumps(known.told(), allow_nan=False)
    store.dumped(found)
    assert found.origin.age_days > -1e9
    format(found.origin.made, "%Y%m%dT%H%M%S")
    if isinstance(found, CameraCalibration):
        assert found.model.width > 0


def _samples() -> list[bytes]:
    return [b"t,x,y\r\n0.0,1.0,2.0\r\n0.1,1.5,2.5\r\n", b"a\n1\n2\n"]


def _decode_samples(data: bytes) -> None:
    load_samples(_written("samples.csv", data))


def _plan_files() -> list[bytes]:
    file = plan_file.save(on_the_bus.plan(), _scratch() / "seed.npz")
    packed = io.BytesIO()
    with np.load(file) as archive:
        np.savez_compressed(packed, **archive)
    return [file.read_bytes(), packed.getvalue()]


def _use_plan(plan: Plan) -> None:
    """What every user of a plan does with it."""
    with np.errstate(all="ignore"):  # figures beyond any hand are for its gates
        plan.reanchored(np.array([0.1, 0.2, 0.3]))
        assert len(plan.free_air_ee(plan.go)) == plan.steps
    assert abs(plan.mass - 1.0) >= 0


def _decode_plan_file(data: bytes) -> None:
    _use_plan(plan_file.load(_written("plan.npz", data)))


def _decode_plan_json(data: bytes) -> None:
    """As the end of a trial in a log carries it."""
    text = data.decode("utf-8", errors="replace")
    begin = TrialRecord(5, "t", "grasped_static", "open_loop")
    plan = plan_of(LoggedTrial(begin, replace(begin, status="completed", plan=text)))
    if plan is not None:
        _use_plan(plan)


def _logs() -> list[bytes]:
    """One as it is written, and one without check sums or packing, so that what is within is tried, too."""
    whole, plain = _scratch() / "whole.mcap", io.BytesIO()
    whole.unlink(missing_ok=True)
    with LogWriter(whole) as log:
        log.add_attachment("experiment.yaml", "application/yaml", b"name: x\n")
        for i in range(4):
            reading = WrenchReading(Stamp(i, i, i, "ft"), np.arange(6.0))
            log.write("sim/ft/wrench", messages.WRENCH, encode_reading(reading), sequence=i, publish_ns=i, log_ns=i)
        log.drain()
        log.write_record(EventRecord(9, "info", "so"))
    writer = Writer(plain, compression=CompressionType.NONE, enable_crcs=False)
    writer.start(profile="ros2", library="x")
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", b"string data")
    channel = writer.register_channel("a", "cdr", schema, {"k": "v"})
    for i in range(3):
        writer.add_message(channel, i, b"\x00\x01\x00\x00\x02\x00\x00\x00a\x00", i, i)
    writer.add_metadata("m", {"a": "b"})
    writer.add_attachment(1, 2, "n", "t", b"data")
    writer.finish()
    loose = io.BytesIO()
    writer = Writer(loose, use_chunking=False, enable_crcs=False)
    writer.start()
    channel = writer.register_channel("a", "cdr", 0)
    writer.add_message(channel, 1, b"abc", 1, 1)
    writer.finish()
    return [whole.read_bytes(), plain.getvalue(), loose.getvalue()]


def _decode_log(data: bytes) -> None:
    reader = LogReader(_written("log.mcap", data))
    for logged in reader.messages():
        try:
            logged.value()
        except ProtocolError:
            continue
    reader.attachments()
    assert reader.ending


def _repair(data: bytes) -> None:
    """What is mended is a whole log with what the reader finds, and perhaps more."""
    folder = _scratch() / "mended"
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    log = folder / "log.mcap"
    log.write_bytes(data)
    account = repair_log(log)
    if account.mended is not None:
        reader = LogReader(account.mended)
        assert sum(reader.counts().values()) == sum(account.kept.values())
        assert reader.complete


def _campaigns() -> list[bytes]:
    """campaign.json, failed.json and results.json, one behind the other."""
    row = {"skill": "grasped_static", "controller": "open_loop", "trial": 0, "sensor": "soft_bubble"}
    figures = {"wrench_N": {"mean": 1.0, "std": 0.1}, "eo_pose_mm": None}
    trial = {**row, "status": "completed", "reason": "", "measured": figures, "truth": None}
    job = {"id": "a-0", "tags": {"mu": 0.3, "seed": 0}, "trials": [row]}
    told = {"schema": 1, "experiment": "e", "jobs": [job]}
    results = {"status": "completed", "reason": "", "trials": [trial]}
    parts = (told, {"reason": "lost"}, results)
    first = b"\n\n".join(json.dumps(part).encode() for part in parts)
    second = b"\n\n".join(
        json.dumps(part).encode() for part in (told, {"reason": "lost"}, {**results, "status": "running"})
    )
    return [first, second]


def _decode_campaign(data: bytes) -> None:
    root = _scratch() / "campaign"
    run = root / "jobs" / "a-0" / "run"
    run.mkdir(parents=True, exist_ok=True)
    told, _, rest = data.partition(b"\n\n")
    failed, _, results = rest.partition(b"\n\n")
    (root / "campaign.json").write_bytes(told)
    (run.parent / "failed.json").write_bytes(failed)
    (run / "results.json").write_bytes(results)
    cells(root, trials_frame(root))


@functools.cache
def _run_folder() -> RunFolder:
    """A run that left an experiment, a log of one event, and results."""
    folder = RunFolder(_scratch() / "run")
    folder.path.mkdir()
    folder.experiment.write_text(files.dump_resolved(files.load("grasped_static")))
    with LogWriter(folder.log) as log:
        log.write_record(EventRecord(9, "info", "so"))
    return folder


def _results() -> list[bytes]:
    figure = {"mean": 1.5, "std": 0.25}
    errors = {"go_pose_mm": figure, "eo_pose_mm": None, "wrench_N": figure, "fx_N": figure, "x_mm": figure}
    row = {
        "name": "p-open_loop-0", "skill": "grasped_static", "planner": "lm", "controller": "open_loop", "go_pose": None,
        "grasped_object": "tall_box", "extrinsic_object": None, "sensor": "soft_bubble", "trial": 0,
        "status": "completed", "reason": "", "deviation": None, "measured": errors, "truth": errors,
        "contact": {"mean_mm": 1.0, "max_mm": 2.0, "waypoints": 3, "not_located": 0}, "witness": None,
    }  # fmt: skip
    plan = {"name": "p", "skill": "grasped_static", "planner": "lm", "steps": 5, "queries": 9, "loss": 0.1}
    calibrations = [store.read(_written("seed.yaml", seed)) for seed in _calibrations()]
    told = {c.name: {"file": "x.yaml", **c.model_dump(mode="json")} for c in calibrations}
    results = {
        "schema": 1, "status": "completed", "reason": "", "experiment": "e", "station": "sim", "profile": "lab",
        "seed": 0,
        "started": "2026-01-02T03:04:05+00:00", "provenance": {"git": "abc", "versions": {"numpy": "2"}, "host": "h"},
        "calibration": told, "plans": [{**plan, "status": "solved", "file": "plans/p.npz", "time_s": 1.0}],
        "trials": [row, {**row, "status": "slipped", "measured": None, "truth": None}], "not_run": [], "tables": [],
        "timing": {"execute_wall_s": 1.0, "execute_station_s": 2.0}, "log": {"lost": 0},
        "repair": {"logs": [{"log": "log.mcap", "ending": "torn", "mended": None}]},
    }  # fmt: skip
    return [json.dumps(results).encode(), json.dumps({"status": "running", "reason": "", "trials": []}).encode()]


_load_once = functools.cache(files.load)


def _decode_results(data: bytes) -> None:
    """The report is made of them."""
    folder = _run_folder()
    folder.results.write_bytes(data)
    with patch("experiments.report.collect.load", _load_once):  # the experiment is not what is tried
        render(collect(folder))


_WORDS = (b"&a [*a, *a]", b"experiment", b"stages:", b"- stage: execute", b"{kind: arm}", b"world:", b"sim")

DECODERS: dict[str, Decoder] = {
    "reading": Decoder(on_the_bus.readings, on_the_bus.take_reading, (ProtocolError,)),
    "record": Decoder(on_the_bus.records, on_the_bus.take_record, (ProtocolError,)),
    "message": Decoder(on_the_bus.others, on_the_bus.take_other, (ProtocolError,)),
    "rdt": Decoder(netft.datagrams, netft.take_datagrams, ()),
    "rdt_setup": Decoder(netft.setups, netft.take_setup, (SetupError,), netft.WORDS),
    "rdt_page": Decoder(netft.pages, netft.take_page, (HttpError, SetupError), netft.WORDS),
    "urdf": Decoder(franka.models, franka.take_model, (ProtocolError,), franka.WORDS),
    "mjpeg": Decoder(mjpeg.answers, mjpeg.take_answer, (ProtocolError, NotConnected), mjpeg.WORDS),
    "jpeg": Decoder(mjpeg.pictures, mjpeg.take_picture, (ProtocolError,), mjpeg.WORDS),
    "yaml": Decoder(_yaml_seeds, _decode_yaml, (InputError,), _WORDS),
    "model": Decoder(_models, _decode_model, (InputError,), _WORDS),
    "experiment": Decoder(_experiments, _decode_experiment, (InputError,), _WORDS),
    "loaded": Decoder(_experiments, _decode_loaded, (InputError,), _WORDS),
    "sets": Decoder(_sets, _decode_sets, (InputError,), (b"stages.", b"world.", b"=", b"devices.")),
    "calibration": Decoder(_calibrations, _decode_calibration, (InputError,), (b"kind: camera", b"origin:")),
    "samples": Decoder(_samples, _decode_samples, (OSError, ValueError, csv.Error)),
    "plan_file": Decoder(_plan_files, _decode_plan_file, (PlanFileError,)),
    "plan_json": Decoder(lambda: [json.dumps(on_the_bus.plan().to_dict()).encode()], _decode_plan_json, ()),
    "log": Decoder(_logs, _decode_log, (ProtocolError,), (b"zstd", b"\x06", struct.pack("<BQ", 5, 3))),
    "log_repair": Decoder(_logs, _repair, (ProtocolError, DriverError), (b"zstd", b"\x06")),
    "campaign": Decoder(_campaigns, _decode_campaign, (InputError,), (b'"tags"', b'"jobs"', b'"trials"', b"NaN")),
    "results": Decoder(_results, _decode_results, (InputError,), (b'"trials"', b"NaN", b'"status"', b'{"a": 1}')),
}
