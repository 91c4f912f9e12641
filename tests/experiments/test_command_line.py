"""What all commands share: help, completion, JSON, errors that name the next command, any terminal."""

from __future__ import annotations

import io
import json
import re
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest

from experiments import bench, completion, reference, shipped
from experiments.cli import app
from experiments.exit_codes import ExitCode
from experiments.runner import Outcome, what_next
from experiments.terminal import prepare

from .conftest import free_port

ROOT = Path(__file__).parents[2]
COMMANDS = dict(reference.commands())
ESCAPE = "\x1b"


class Told(NamedTuple):
    code: int
    out: str
    err: str


Tell = Callable[..., Told]


class Stream(io.TextIOWrapper):
    """A stream that says whether it is a terminal."""

    def __init__(self, encoding: str, terminal: bool):
        super().__init__(io.BytesIO(), encoding=encoding, write_through=True)
        self._terminal = terminal

    def isatty(self) -> bool:
        return self._terminal

    def text(self) -> str:
        self.flush()
        return self.buffer.getvalue().decode(self.encoding)  # type: ignore[attr-defined]


@pytest.fixture
def tell(monkeypatch: pytest.MonkeyPatch) -> Tell:
    """Call the command in this process, on streams of an encoding, on a terminal or not."""

    def called(*arguments: str, encoding: str = "utf-8", terminal: bool = False, columns: int = 160) -> Told:
        out, err = Stream(encoding, terminal), Stream(encoding, terminal)
        monkeypatch.setattr(sys, "stdout", out)
        monkeypatch.setattr(sys, "stderr", err)
        monkeypatch.setenv("COLUMNS", str(columns))
        monkeypatch.setenv("TERM", "xterm-256color")
        for name in ("FORCE_COLOR", "GITHUB_ACTIONS", "PY_COLORS"):
            monkeypatch.delenv(name, raising=False)
        prepare(app)
        code = 0
        try:
            app(list(arguments), prog_name="extrinsic")
        except SystemExit as end:
            code = int(end.code or 0)
        return Told(code, out.text(), err.text())

    return called


@pytest.fixture
def nowhere() -> str:
    """Where nothing listens."""
    return f"bus.endpoint=tcp/127.0.0.1:{free_port()}"


# -- help and reference ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", COMMANDS)
def test_help_has_an_example_and_is_readable_in_60_columns_without_colour_or_utf8(name: str, tell: Tell) -> None:
    told = tell(*name.split(), "--help", encoding="ascii", columns=60)
    assert told.code == 0
    assert ESCAPE not in told.out
    assert max(map(len, told.out.splitlines())) <= 60
    words = " ".join(told.out.split())
    assert f"Example: extrinsic {name} " in words
    for option, _ in reference.options(COMMANDS[name]):
        assert option.split()[0] in words


@pytest.mark.parametrize("name", ["", "lab"])
def test_the_list_of_commands_is_readable_there_too(name: str, tell: Tell) -> None:
    told = tell(*name.split(), "--help", encoding="ascii", columns=60)
    assert told.code == 0
    assert max(map(len, told.out.splitlines())) <= 60
    for command in COMMANDS:
        if command.startswith(name) and (name or " " not in command):
            assert re.search(rf"\b{command.removeprefix(name).strip()}\b", told.out)


def test_the_docs_have_every_command_and_option_as_help_has_them() -> None:
    page = (ROOT / "docs" / "command-line.md").read_text(encoding="utf-8")
    assert page.endswith(reference.markdown()), "python -m experiments.reference prints what belongs there"


def test_the_readme_names_every_command() -> None:
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert [name for name in COMMANDS if f"extrinsic {name.split()[0]} " not in readme] == []


# -- completion --------------------------------------------------------------------------------------------------------


def completed(monkeypatch: pytest.MonkeyPatch, tell: Tell, words: str) -> list[str]:
    """What bash is offered for the last of ``words``."""
    monkeypatch.setenv("_EXTRINSIC_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", words)
    monkeypatch.setenv("COMP_CWORD", str(len(words.split(" ")) - 1))
    return tell().out.split()


@pytest.mark.parametrize(
    ("words", "offered"),
    [
        ("extrinsic st", ["status", "stop"]),
        ("extrinsic lab re", ["revoke", "renew"]),
        ("extrinsic status sim --w", ["--watch"]),
        ("extrinsic run demo", ["demo"]),
        ("extrinsic run --station emu", ["emulated_lab"]),
        ("extrinsic table p", ["pivoting"]),
        ("extrinsic bench lo", ["load"]),
        ("extrinsic check-device sim wr", ["wrist_ft"]),
        ("extrinsic serve sim finger", ["finger_left", "finger_right"]),
        ("extrinsic report runs/m", ["runs/mine-20260101T000000.000000"]),
        ("extrinsic check ow", ["own.yaml"]),
        ("extrinsic status la", ["lab7"]),
        ("extrinsic check-device nowhere wr", []),
    ],
)
def test_the_shell_completes(
    words: str, offered: list[str], monkeypatch: pytest.MonkeyPatch, tell: Tell, tmp_path: Path
) -> None:
    run = tmp_path / "runs" / "mine-20260101T000000.000000"
    run.mkdir(parents=True)
    (tmp_path / "stations").mkdir()
    for file in (run / "experiment.yaml", tmp_path / "own.yaml", tmp_path / "stations" / "lab7.yaml"):
        file.touch()
    monkeypatch.chdir(tmp_path)
    assert completed(monkeypatch, tell, words) == offered


def test_what_is_completed_is_what_there_is(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.chdir(tmp_path)
    assert set(shipped.BENCHMARKS) == set(bench.BENCHMARKS)
    assert dict(completion.tables("")).keys() == {"grasped", "extrinsic", "pivoting", "optimizers"}
    assert {"targets", "paper_tables", "table_grasped"}.isdisjoint(dict(completion.experiments("")))
    assert all(said for said in shipped.experiments().values())


# -- JSON --------------------------------------------------------------------------------------------------------------


def test_check_as_json_says_what_would_run_and_what_is_wrong_where(tell: Tell, tmp_path: Path) -> None:
    told = tell("check", "grasped_static", "--json", "-")
    data = json.loads(told.out)
    assert (told.code, data["schema"], data["ok"], data["station"]) == (0, 1, True, "sim")
    assert data["lines"][0] == "experiment grasped_static, seed 0"
    assert data["lines"][0] in told.err  # people read on

    file = tmp_path / "new" / "found.json"
    told = tell("check", "grasped_static", "--set", "trial.rampp=1", "--json", str(file))
    [problem] = json.loads(file.read_text())["problems"]
    assert told.code == 2 and "rampp" in told.err
    assert (problem["key"], problem["nearest"]) == ("trial.rampp", "trial.ramp")


def test_status_as_json_of_a_station_that_does_not_run(tell: Tell, nowhere: str) -> None:
    told = tell("status", "sim", "--set", nowhere, "--json", "-")
    data = json.loads(told.out)
    assert told.code == 3
    assert (data["schema"], data["station"], data["alive"], len(data["devices"])) == (1, "sim", False, 7)
    arm = data["devices"][0]
    assert (arm["name"], arm["alive"], arm["rate_Hz"], arm["arm"]) == ("arm", False, None, None)
    assert "nothing listens at" in arm["trouble"]


def test_json_that_cannot_be_written_is_bad_input(tell: Tell, nowhere: str, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    told = tell("status", "sim", "--set", nowhere, "--json", str(tmp_path / "file" / "x.json"))
    assert told.code == 2
    assert "--json: cannot be written" in told.err


# -- errors that name the next command ---------------------------------------------------------------------------------


def test_a_name_that_is_not_shipped_is_answered_with_those_that_are(tell: Tell) -> None:
    told = tell("status", "simm")
    assert told.code == 2
    assert "emulated_lab, example_lab, sim" in told.err and "nearest:  sim" in told.err
    told = tell("check", "grasped_statik")
    assert "nearest:  grasped_static" in told.err
    assert "targets" not in told.err  # which is no experiment


def test_a_station_that_does_not_run_is_answered_with_how_to_start_it(tell: Tell, nowhere: str) -> None:
    assert "extrinsic serve sim" in tell("status", "sim", "--set", nowhere).err
    told = tell("stop", "sim", "--set", nowhere, "--set", "bus.timeout=0.2")
    assert told.code == 3
    assert "nothing listens there" in told.err and "extrinsic serve STATION" in told.err


def test_a_folder_that_is_no_run_is_answered_with_the_newest_that_is(
    tell: Tell, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    assert "extrinsic run EXPERIMENT" in tell("report", "gone").err
    (tmp_path / "runs" / "mine").mkdir(parents=True)
    (tmp_path / "runs" / "mine" / "experiment.yaml").touch()
    assert "nearest:  runs/mine" in tell("replay", "gone").err


@pytest.mark.parametrize(
    ("code", "named"),
    [
        (ExitCode.DONE, []),
        (ExitCode.FELL_SHORT, []),
        (ExitCode.INTERRUPTED, ["extrinsic run --resume runs/a"]),
        (ExitCode.DEVICE_FAILED, ["extrinsic status lab1", "extrinsic run --resume runs/a"]),
        (ExitCode.STOPPED, ["extrinsic recover lab1", "extrinsic run --resume runs/a"]),
        (ExitCode.INFEASIBLE, ["extrinsic check runs/a/experiment.yaml"]),
    ],
)
def test_a_run_that_did_not_end_well_names_what_helps(code: ExitCode, named: list[str]) -> None:
    folder: Any = SimpleNamespace(path=Path("runs/a"))
    lines = what_next(Outcome(code, folder, {"station": "lab1"}))
    assert [line.split(": ", 1)[1] for line in lines] == named


# -- colour ------------------------------------------------------------------------------------------------------------


def test_colours_are_for_a_terminal_and_for_who_wants_them(
    tell: Tell, nowhere: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NO_COLOR", raising=False)
    status = ("status", "sim", "--set", nowhere)
    assert ESCAPE in tell(*status, terminal=True).out
    assert ESCAPE not in tell(*status).out
    monkeypatch.setenv("NO_COLOR", "1")
    assert ESCAPE not in tell(*status, terminal=True).out
    assert ESCAPE not in tell("status", "--help", terminal=True).out
    assert ESCAPE not in tell("status", "--help", terminal=True, columns=60).out


def test_what_a_command_says_is_ascii_where_the_terminal_has_no_more(tell: Tell, nowhere: str) -> None:
    for arguments in (("status", "sim", "--set", nowhere), ("check", "grasped_static"), ("status", "nö/wo")):
        told = tell(*arguments, encoding="ascii", columns=60)
        assert told.code in (0, 2, 3)
        assert (told.out + told.err).isascii()


def test_an_option_that_does_not_exist_is_told_without_a_traceback_there(tell: Tell) -> None:
    told = tell("status", "--wach", encoding="ascii", columns=60)
    assert told.code == 2
    assert "--watch" in told.err
