"""What can be played: the files of a recording, and what they say of their devices."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

from mcap.records import Attachment, Channel, Message, Schema

from drivers.config import DeviceConfig, StationConfig
from drivers.descriptions import DESCRIPTIONS, LoggedStation
from drivers.errors import NotConnected, ProtocolError
from drivers.interfaces import Description
from drivers.wire import topics
from drivers.wire.log_reader import LogReader
from drivers.wire.log_repair import to_read, written_logs
from mechanics.yaml_input import InputError, parse, read_text

EXPERIMENT = "experiment.yaml"
"""The attachment that has a run's experiment and station."""

#: messages within which a log says what it has to say of its devices
_HEAD = 5000
_REMEDY = "Give a run's folder or its log.mcap, as `extrinsic run` leaves them"


@dataclass(frozen=True)
class Contents:
    """The ``files`` to play in their order, the ``station`` they were recorded at, and its devices by name.

    ``lockstep`` says whether its time stood still while somebody waited; ``experiment`` is the run's own file, empty
    where the log has none.
    """

    files: tuple[Path, ...]
    station: str
    lockstep: bool
    devices: dict[str, Description] = field(default_factory=dict)
    experiment: str = ""


def files_of(path: Path) -> tuple[Path, ...]:
    """The logs of a run folder in their order, each in its mended form where there is one; of a file, itself.

    Raises NotConnected where there is none.
    """
    found = written_logs(path) if path.is_dir() else [path]
    files = tuple(to_read(file) for file in found)
    missing = next((file for file in files if not file.is_file()), None)
    if missing is not None or not files:
        got = "there is no log in this folder" if path.is_dir() else "there is no such file or folder"
        raise NotConnected("recording", f"play {path}", got, _REMEDY)
    return files


def contents_of(path: Path) -> Contents:
    """Look at the begin of a recording. Raises NotConnected for what is no recording."""
    files = files_of(path)
    found: Contents | None = None
    refused: list[str] = []
    for file in files:
        try:
            found = _head(file)
        except (ProtocolError, OSError) as error:  # a run that was killed before the first byte was on the disk
            refused.append(error.got if isinstance(error, ProtocolError) else str(error))
            continue
        if found.devices:
            break
    if found is None:
        raise NotConnected("recording", f"play {path}", refused[0], _REMEDY)
    return replace(found, files=files)


def _head(file: Path) -> Contents:
    said: LoggedStation | None = None
    experiment, messages = "", 0
    types: dict[str, str] = {}
    schemas: dict[int, str] = {}
    for record in LogReader(file).records():
        if isinstance(record, Attachment) and record.name == DESCRIPTIONS:
            try:
                said = LoggedStation.read(record.data)
            except ValueError:
                continue  # as a log that has none
        elif isinstance(record, Attachment) and record.name == EXPERIMENT:
            experiment = record.data.decode("utf-8", errors="replace")
        elif isinstance(record, Schema):
            schemas[record.id] = record.name
        elif isinstance(record, Channel):
            types[record.topic] = schemas.get(record.schema_id, "")
        elif isinstance(record, Message):
            messages += 1
            if messages > _HEAD:
                break
    if said is None:
        said = _by_station_file(experiment) or _by_topics(types)
    return Contents((file,), said.station, said.lockstep, said.devices, experiment)


def _by_station_file(experiment: str) -> LoggedStation | None:
    """What an older log's station file says; None where it says nothing."""
    try:
        document = read_text(experiment, EXPERIMENT)
        config = parse(StationConfig, document.part("station"))
    except (InputError, KeyError, TypeError, ValueError):
        return None
    lockstep = config.world is not None and config.world.clock == "lockstep"
    return LoggedStation(config.name, lockstep, {name: _declared(name, d) for name, d in config.devices.items()})


def _declared(name: str, config: DeviceConfig) -> Description:
    known = ("mount", "pose", "sensor", "finger", "width", "height")
    said = {key: value for key, value in config.model_dump(mode="json").items() if key in known}
    return _nameless(name, config.kind, config.rate, said)


def _nameless(name: str, kind: str, rate: float = 0.0, extra: dict | None = None) -> Description:
    """A device of which the log has no description."""
    frame = "world" if kind == "arm" else name
    return Description(name, kind, "not described in its log", "replay", "unknown", frame, rate, extra=extra or {})


def _by_topics(types: dict[str, str]) -> LoggedStation:
    """The devices whose streams are there; that of a log that nobody described."""
    station, devices = "", {}
    for kind, streams in topics.STREAMS.items():
        (stream, type_name), plain = next(iter(streams.items())), kind.partition("/")[0]
        if kind == topics.WORLD:
            continue
        for topic, found in types.items():
            parts = topic.split("/")
            if len(parts) != 3 or parts[2] != stream or found != type_name or parts[1] == topics.ESTIMATOR:
                continue
            if plain == "tactile" and any(other.startswith(f"{parts[0]}/{parts[1]}/detections") for other in types):
                continue  # the picture behind a camera's tags
            station = station or parts[0]
            if parts[0] == station:
                devices[parts[1]] = _nameless(parts[1], plain)
    return LoggedStation(station, False, devices)
