"""The checklist of each kind, and the way through it."""

from __future__ import annotations

import json
from collections.abc import Callable, Collection, Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from time import monotonic
from typing import Any

from rich.console import Console
from rich.text import Text

from drivers.config import StationConfig
from drivers.errors import DriverError
from experiments.check_device import arm, force_torque, gripper, tactile, tag_camera
from experiments.check_device.bench import Bench, Step
from experiments.check_device.findings import Finding, Verdict, judged, of_error, skipped
from experiments.check_device.opening import opened
from experiments.check_device.person import Person
from experiments.check_device.stream import STREAM
from experiments.exit_codes import ExitCode
from experiments.json_output import put
from mechanics.yaml_input import InputError, Problem, nearest, one_of

STEPS: dict[str, tuple[Step, ...]] = {
    "arm": arm.STEPS,
    "force_torque": force_torque.STEPS,
    "gripper": gripper.STEPS,
    "tactile": tactile.STEPS,
    "tag_camera": tag_camera.STEPS,
}
"""The steps of each kind, after those that all have."""

REACH = "reach"
_STYLES = {Verdict.GOOD: "green", Verdict.SHORT: "yellow", Verdict.FAILED: "red", Verdict.SKIPPED: "dim"}


def steps_of(kind: str) -> tuple[Step, ...]:
    """Every step of a kind, in their order."""
    return (*STREAM, *STEPS[kind])


def walk(
    config: StationConfig,
    name: str,
    person: Person,
    *,
    move: bool = False,
    reference: Path | None = None,
    only: Collection[str] = (),
    begin: Callable[[str, str], None] = lambda _name, _look: None,
) -> Iterator[tuple[str, str, Finding]]:
    """Open the device ``name`` and take its steps: each one's name, what to look at, and what was found.

    ``begin`` is called with the former two before a step. Where ``only`` names steps, no others are taken. A device
    that cannot be opened is a finding, and the last one.
    """
    kind = config.devices[name].kind
    look, begun = "whether it answers", monotonic()
    begin(REACH, look)
    try:
        with opened(config, name) as found:
            yield REACH, look, judged(True, f"{found.how}; open after {monotonic() - begun:.1f} s")
            bench = Bench(found, person, move, reference)
            for step in steps_of(kind):
                if not only or step.name in only:
                    begin(step.name, step.look)
                    yield step.name, step.look, _done(step, bench)
    except DriverError as error:  # only from opening, or closing: a step's errors are findings
        yield REACH, look, Finding(Verdict.FAILED, f"{error.asked}: {error.got}", error.remedy)


def _done(step: Step, bench: Bench) -> Finding:
    if step.asks and not bench.opened.commands:
        return skipped("the keys of this machine may only look")
    try:
        return step.do(bench)
    except DriverError as error:
        return of_error(error)


def exit_code(verdicts: list[Verdict]) -> ExitCode:
    """3 where the device did not do what was asked, 1 where something is not as it should be."""
    if Verdict.FAILED in verdicts:
        return ExitCode.DEVICE_FAILED
    return ExitCode.FELL_SHORT if Verdict.SHORT in verdicts else ExitCode.DONE


def check_device(
    config: StationConfig,
    name: str,
    person: Person,
    console: Console,
    *,
    move: bool = False,
    reference: Path | None = None,
    only: Sequence[str] = (),
    json_file: Path | None = None,
) -> ExitCode:
    """Walk through the checklist of a device, tell each step as it ends, and return the exit code.

    Raises InputError for a step that its kind has not, or a ``json_file`` that cannot be written.
    """
    if json_file is not None and not json_file.parent.is_dir():  # before a person has walked through all of it
        wrong, expected = f"there is no folder {json_file.parent}", "a file in a folder that is there"
        raise InputError([Problem("check-device", None, "--json", wrong, expected)])
    device = config.devices[name]
    names = [step.name for step in steps_of(device.kind)]
    for unknown in [step for step in only if step not in names]:
        wrong = f"{device.kind} has no step {unknown!r}"
        raise InputError([Problem("check-device", None, "--step", wrong, one_of(names), nearest(unknown, names))])
    console.print(Text(f"{name} of {config.name}: {device.kind}, {device.backend}"))
    rows: list[dict[str, Any]] = []

    def begin(step: str, look: str) -> None:
        console.print(Text.assemble((f"{step:13}", "bold"), (look, "dim")), soft_wrap=True)

    for step, look, finding in walk(config, name, person, move=move, reference=reference, only=only, begin=begin):
        _tell(console, finding)
        rows.append({"step": step, "look": look, **asdict(finding)})
    code = exit_code([row["verdict"] for row in rows])
    counts = {verdict: sum(row["verdict"] is verdict for row in rows) for verdict in Verdict}
    console.print(Text(", ".join(f"{count} {verdict}" for verdict, count in counts.items() if count)))
    if json_file is not None:
        said = {"schema": 1, "station": config.name, "device": name, "kind": device.kind, "backend": device.backend}
        put(json_file, said | {"exit_code": int(code), "steps": json.loads(json.dumps(rows))})
    return code


def _tell(console: Console, finding: Finding) -> None:
    line = Text.assemble((f"    {finding.verdict:9}", _STYLES[finding.verdict]), finding.measured)
    console.print(line, soft_wrap=True)
    if finding.remedy:
        console.print(Text(f"{'':13}{finding.remedy}"), soft_wrap=True)
