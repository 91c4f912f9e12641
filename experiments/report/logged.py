"""What the logs of a run say, in one pass: trials with their waypoints, phases and truth, events, counts."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from drivers.errors import ProtocolError
from drivers.log_health import LogHealth
from drivers.wire.log_reader import LogReader
from experiments.progress import Heard, unheard
from experiments.report.pictures import Pictures, Strip
from experiments.run_folder import RunFolder
from mechanics.readings import TruthReading
from mechanics.records import EventRecord, PhaseRecord, TrialRecord, WaypointRecord

_TELL = 1000  # messages


@dataclass
class LoggedTrial:
    """A trial as the log has it; ``end`` is None where the log breaks off within it."""

    begin: TrialRecord
    end: TrialRecord | None = None
    waypoints: list[WaypointRecord] = field(default_factory=list)
    phases: list[PhaseRecord] = field(default_factory=list)
    truths: list[TruthReading] = field(default_factory=list)
    pictures: dict[str, Strip] = field(default_factory=dict)


@dataclass
class Logs:
    """What the logs of a run folder say, one after the other; ``ending`` says how the first broke off that did.

    ``begin_ns`` is the station's time of the first message, ``length_ns`` what all logs last together.
    """

    trials: list[LoggedTrial] = field(default_factory=list)
    events: list[EventRecord] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)
    begin_ns: int | None = None
    length_ns: int = 0
    ending: str = "there is no log"
    current: LoggedTrial | None = None


def read_logs(
    folder: RunFolder,
    rate: float,
    heard: Heard = unheard,
    *,
    pictures: Pictures | None = None,
    health: LogHealth | None = None,
) -> Logs:
    """One pass over the logs of a run; truth is thinned to ``rate`` [Hz] on the way. ``heard`` as in `collect`.

    Of a trial that was run again, in the same log or in that of the run that went on, the last attempt counts.
    ``pictures`` and ``health``, where they are given, see every message.
    """
    log, files = Logs(), folder.logs()
    for number, file in enumerate(files):
        log.current = None
        reading = _Reading(log, rate, pictures, health)
        ending = reading.file(file, lambda share, before=number: heard((before + share) / len(files)))
        if log.ending in ("complete", "there is no log"):
            log.ending = ending
    return log


@dataclass
class _Reading:
    log: Logs
    rate: float
    pictures: Pictures | None
    health: LogHealth | None

    def file(self, file: Path, heard: Heard) -> str:
        """Add what is in one file; how it ends."""
        try:
            reader = LogReader(file)
        except ProtocolError as error:
            return error.got
        log, first_ns, last_ns, next_truth = self.log, None, 0, 0
        for count, message in enumerate(reader.messages()):
            if count % _TELL == 0:
                heard(reader.share)
            log.counts[message.topic] = log.counts.get(message.topic, 0) + 1
            first_ns = message.publish_ns if first_ns is None else min(first_ns, message.publish_ns)
            last_ns = max(last_ns, message.publish_ns)
            if self.health is not None:
                self.health.take(message)
            is_truth = message.topic.endswith("/world/truth")
            if is_truth and message.publish_ns < next_truth:
                continue
            if not is_truth and not message.topic.startswith("run/"):
                if self.pictures is not None:
                    self.pictures.take(message)
                continue
            try:
                value = message.value()
            except ProtocolError:
                continue
            if isinstance(value, TruthReading):
                next_truth = message.publish_ns + round(1e9 / self.rate) - 1
            _file(log, value, self.pictures)
        if self.health is not None:
            self.health.end_file()
        if first_ns is not None:
            log.begin_ns = first_ns if log.begin_ns is None else min(log.begin_ns, first_ns)
            log.length_ns += last_ns - first_ns
        return reader.ending


def _file(log: Logs, value: object, pictures: Pictures | None) -> None:
    current = log.current
    if isinstance(value, EventRecord):
        log.events.append(value)
    elif isinstance(value, TrialRecord):
        if value.status and current is not None:
            current.end, log.current = value, None
            if pictures is not None:
                pictures.end()
        elif not value.status:
            log.current = LoggedTrial(value)
            if log.trials and log.trials[-1].begin.trial == value.trial:
                log.trials.pop()
            log.trials.append(log.current)
            if pictures is not None:
                log.current.pictures = pictures.begin()
    elif current is None:
        return
    elif isinstance(value, WaypointRecord):
        current.waypoints.append(value)
        if pictures is not None:
            pictures.settle(value.step)
    elif isinstance(value, PhaseRecord):
        current.phases.append(value)
    elif isinstance(value, TruthReading):
        current.truths.append(value)
