"""What `extrinsic view` does."""

from __future__ import annotations

import time
import webbrowser
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Self

from rich.console import Console

from experiments.interrupt import Interrupt
from experiments.view import foxglove, package
from mechanics.yaml_input import InputError, Problem

if TYPE_CHECKING:
    import rerun as rr

    from drivers.config import StationConfig

_FLUSH = 30.0
_PATIENCE = 0.5
_CLOSING = "closing the viewer"


@dataclass(frozen=True)
class Options:
    """How to show it: in a browser at ``port``, which is opened unless told otherwise, or into the file ``save``.

    ``seconds``: look at a live station for so long only.
    """

    web: bool = False
    port: int | None = None
    browser: bool = True
    save: Path | None = None
    seconds: float | None = None

    def checked(self) -> Options:
        """Itself. Raises InputError for options that do not go together."""
        wrong: list[tuple[str, str, str]] = []
        if self.save is not None and self.web:
            wrong.append(("--save", "a file is written, or it is shown", "--save FILE or --web"))
        if not self.web:
            given = (("--port", self.port is not None), ("--no-browser", not self.browser))
            wrong += [(name, "it is of the web viewer", f"--web {name}") for name, there in given if there]
        if wrong:
            raise InputError([Problem("view", None, *one) for one in wrong])
        return self


def main(target: str | None, sets: Sequence[str], options: Options, layout: Path | None, said: Console) -> None:
    """Show a run or a station, or write a ``layout`` for Foxglove to a file. Raises InputError, NotConnected."""
    if layout is not None:
        foxglove.write(layout, None if target is None else _station_name(target, sets))
        _tell(said, f"layout: {layout}; import it in Foxglove, and open a run's log.mcap there")
        return
    if target is None:
        expected = "a run folder, a log.mcap, or a station"
        raise InputError([Problem("view", None, "RUN | STATION", "it is missing", expected)])
    package.need()
    path, options = Path(target), options.checked()
    if path.is_dir() or path.suffix == ".mcap":
        if sets or options.seconds is not None:
            given = "--set" if sets else "--seconds"
            raise InputError([Problem("view", None, given, "a recorded run is as it is", f"a run without {given}")])
        _show_run(path, options, said)
    else:
        _show_station(_station(target, sets), options, said)


def _station(target: str, sets: Sequence[str]) -> StationConfig:
    """The station that is meant. Raises InputError."""
    from experiments.files import load_station

    try:
        return load_station(target, sets)
    except InputError as error:
        if Path(target).suffix in (".yaml", ".yml") or "no such" not in error.problems[0].wrong:
            raise
        there = error.problems[0].expected
        wrong = "there is no such run folder, and no such station"
        raise InputError(
            [Problem(target, None, "RUN | STATION", wrong, f"a folder under runs/, or a station: {there}")]
        ) from None


def _station_name(target: str, sets: Sequence[str]) -> str:
    """The station of a run, or a station's own name. Raises InputError."""
    from experiments.files import load
    from experiments.run_folder import RunFolder

    path = Path(target)
    return load(str(RunFolder.open(path).experiment)).station.name if path.is_dir() else _station(target, sets).name


def _show_run(path: Path, options: Options, said: Console) -> None:
    from experiments.view.recorded import recorded, write

    if not path.exists():
        raise InputError([Problem(str(path), None, "RUN", "there is no such file", "a run's folder or its log.mcap")])
    run = recorded(path)

    def fill(recording: rr.RecordingStream) -> None:
        for line in write(run, recording, lambda line: _tell(said, line)):
            _tell(said, line)

    with Interrupt(_CLOSING) as interrupt:
        if options.save is not None:
            with _File(options.save, run.name) as recording:
                fill(recording)
            _tell(said, f"saved: {options.save}")
            return
        with suppress(KeyboardInterrupt), _Shown(options, run.name, interrupt) as shown:
            fill(shown.recording)
            shown.announce(said)
            while not shown.viewer.wait(_PATIENCE):
                interrupt.check()


def _show_station(config: StationConfig, options: Options, said: Console) -> None:
    from drivers.onlooker import Onlooker
    from experiments.view.live import follow, ready

    end = None if options.seconds is None else time.monotonic() + options.seconds
    with Interrupt(_CLOSING) as interrupt, Onlooker(config) as onlooker:
        _tell(said, ready(config))

        def going() -> bool:
            interrupt.check()
            return end is None or time.monotonic() < end

        def tell(line: str) -> None:
            _tell(said, line)

        if options.save is not None:
            with _File(options.save, config.name) as recording, suppress(KeyboardInterrupt):  # the usual end
                follow(onlooker, recording, going, tell)
            _tell(said, f"saved: {options.save}")
            return
        with suppress(KeyboardInterrupt), _Shown(options, config.name, interrupt) as shown:
            shown.announce(said)
            follow(onlooker, shown.recording, lambda: going() and shown.viewer.open, tell)
            while going() and not shown.viewer.wait(_PATIENCE):
                pass


class _Shown:
    """A viewer, and a recording that goes there."""

    def __init__(self, options: Options, name: str, interrupt: Interrupt):
        from experiments.view.viewer import PORT, Viewer

        self._browser, self._interrupt = options.browser, interrupt
        self.viewer = Viewer(web=options.web, port=PORT if options.port is None else options.port)
        self.recording = _new(name)

    def __enter__(self) -> Self:
        self.viewer.__enter__()
        self.recording.connect_grpc(self.viewer.data)
        return self

    def __exit__(self, *_: object) -> None:
        self._interrupt.closing()
        self.recording.disconnect()
        self.viewer.__exit__(None, None, None)

    def announce(self, said: Console) -> None:
        """Say where it is shown, and open a browser there if that is wanted."""
        self.recording.flush(timeout_sec=_FLUSH)
        if not self.viewer.url:
            _tell(said, "shown in Rerun; close its window, or press Ctrl-C")
            return
        _tell(said, f"shown at {self.viewer.url}")
        _tell(said, "Ctrl-C ends it")
        if self._browser:
            webbrowser.open(self.viewer.url)


class _File:
    """A recording into a file, written aside, so that a half one never lies there."""

    def __init__(self, path: Path, name: str):
        self._path, self._name = path, name
        self._aside = path.with_name(f".{path.name}.part")

    def __enter__(self) -> rr.RecordingStream:
        if self._path.is_dir() or not self._path.parent.is_dir():
            wrong = "it is a folder" if self._path.is_dir() else "there is no such folder"
            raise InputError([Problem(str(self._path), None, "--save", wrong, "a file in a folder that is there")])
        try:
            self._aside.touch()
        except OSError as error:
            wrong = f"it cannot be written: {error.strerror}"
            raise InputError([Problem(str(self._path), None, "--save", wrong, "a file you may write")]) from None
        self._recording = _new(self._name)
        self._recording.save(self._aside)
        return self._recording

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._recording.flush(timeout_sec=_FLUSH)
        self._recording.disconnect()
        if kind is None:
            self._aside.replace(self._path)
        else:
            self._aside.unlink(missing_ok=True)


def _new(name: str) -> rr.RecordingStream:
    import rerun as rr

    recording = rr.RecordingStream(package.APPLICATION)
    recording.send_recording_name(name)
    return recording


def _tell(said: Console, line: str) -> None:
    said.print(line, soft_wrap=True, highlight=False, markup=False)
