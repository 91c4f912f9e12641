"""A page of the docs, followed as it stands: what it calls a file is written, its shell blocks are run, what it shows
is compared.

In a page, a block that begins with ``# file: NAME`` is that file. A block of ``sh`` is run, and has to end with 0, or
with the code of a comment ``# exit code N``; a block of ``text`` is what the block before it prints, in part: each line
is found, after the one before it. ``…`` stands for anything, and figures are compared as measurements are.
"""

from __future__ import annotations

import os
import re
import shlex
import socket
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[1]
#: figures that differ by less than both are the same measurement, made on another machine
ABSOLUTE, RELATIVE = 0.02, 0.05
_NUMBER = re.compile(r"(?<![\w.])-?\d+(?:\.\d+)?")


@dataclass(frozen=True)
class Block:
    """A fenced block: its ``language``, its ``text``, and the ``file`` that it is, or ''."""

    language: str
    text: str
    file: str = ""


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in its order."""
    found = []
    for language, text in re.findall(r"^```(\w+)\n(.*?)^```$", page.read_text(), re.MULTILINE | re.DOTALL):
        named = re.match(r"# file: (\S+)\n", text)
        found.append(Block(language, text[named.end() :], named.group(1)) if named else Block(language, text))
    return found


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return probe.getsockname()[1]


class Reader:
    """Somebody who follows a page in an empty ``folder``, in an environment of their own.

    ``pip install .`` installs there, without a network; what a page installs from elsewhere is there already. The bus
    is at a free port, wherever the page has it.
    """

    def __init__(self, folder: Path):
        self.folder = folder / "work"
        self.site = folder / "site"
        commands = folder / "bin"
        for made in (self.folder, self.site, commands):
            made.mkdir()
        python = shlex.quote(sys.executable)
        offline = f"--quiet --no-index --no-deps --no-build-isolation --target {shlex.quote(str(self.site))}"
        scripts = {
            "python": f'exec {python} "$@"',
            "pytest": f'exec {python} -m pytest -q -p no:cacheprovider "$@"',
            "pip": f'[ "$*" != "install pytest" ] || exit 0\nexec {python} -m pip "$@" {offline}',
            "extrinsic": 'if [ "$1" = run ]; then set -- "$@" --set bus.endpoint="$ENDPOINT"; fi\n'
            f'exec {python} -m experiments.cli "$@"',
        }
        for name, script in scripts.items():
            (commands / name).write_text(f"#!/bin/sh\n{script}\n")
            (commands / name).chmod(0o755)
        self._environment = os.environ | {
            "PATH": os.pathsep.join([str(commands), os.environ["PATH"]]),
            "PYTHONPATH": os.pathsep.join([str(self.site), str(ROOT)]),
            "PYTHONDONTWRITEBYTECODE": "1",
            "PIP_DISABLE_PIP_VERSION_CHECK": "1",
            "COLUMNS": "160",
            "OMP_NUM_THREADS": "1",
        }

    def follow(self, page: Path) -> None:
        """Do what the page says, from its top to its bottom; AssertionError where it does not hold."""
        printed = ""
        for block in blocks(page):
            if block.file:
                (self.folder / block.file).write_text(block.text)
            elif block.language == "sh":
                printed = self.run(block.text)
            elif block.language == "text":
                assert_shown(block.text, printed)

    def run(self, commands: str, timeout: float = 200) -> str:
        """Run the lines of a shell block, and return all that they print."""
        printed = ""
        for line in commands.splitlines():
            expected = re.search(r"# exit code (\d+)", line)
            process = subprocess.Popen(
                ["bash", "-c", line],
                cwd=self.folder,
                env=self._environment | {"ENDPOINT": f"tcp/127.0.0.1:{free_port()}"},
                stdin=subprocess.DEVNULL,
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                start_new_session=True,
            )
            try:
                out, _ = process.communicate(timeout=timeout)
            finally:
                if process.poll() is None:
                    os.killpg(process.pid, 9)
            assert process.returncode == int(expected.group(1) if expected else 0), f"{line}\n{out}"
            printed += out
        return printed


def assert_shown(shown: str, printed: str) -> None:
    """Each line that a page shows stands in what was printed, in this order."""
    lines = iter(printed.splitlines())
    for wanted in filter(None, (line.strip() for line in shown.splitlines())):
        if wanted == "…":
            continue
        assert any(_same(wanted, line) for line in lines), f"{wanted!r} is not printed, in its place, in\n{printed}"


def _same(wanted: str, line: str) -> bool:
    wanted, line = " ".join(wanted.split()), " ".join(line.split())
    pattern = "".join(
        ".*" if part == "…" else r"(-?\d+(?:\.\d*)?)" if _NUMBER.fullmatch(part) else re.escape(part)
        for part in re.split(rf"(…|{_NUMBER.pattern})", wanted)
    )
    found = re.fullmatch(pattern, line)
    if found is None:
        return False
    figures = zip(_NUMBER.findall(wanted), found.groups(), strict=True)
    return all(abs(float(a) - float(b)) <= max(ABSOLUTE, RELATIVE * abs(float(a))) for a, b in figures)
