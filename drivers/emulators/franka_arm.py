"""A Franka arm and hand on this machine: `franky_sim`, which speaks the robot's wire protocol, in a child process.

The robot's ports (1337 and 1338) are fixed, so each emulated robot has a loopback address of its own.
"""

from __future__ import annotations

import importlib.util
import json
import logging
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from time import monotonic
from typing import IO, Self

import numpy as np

from drivers.errors import DeviceTimeout, NotConnected
from drivers.real.arm_frames import ArmFrames
from mechanics.readings import Array

#: how long it may take to start, and to end [s]
START, STOP = 30.0, 5.0
#: it follows its commanded joints as a first-order system with this time constant [s]; franky_sim's own is 0.1
DAMPING = 0.02
_RECORD_SIZE = 17 * 8
_HERE = str(Path(__file__).resolve().parent.parent.parent)

log = logging.getLogger(__name__)


class FrankaArmEmulator:
    """An emulated Franka, while it is entered; `host` is where a driver finds it.

    ``frames`` says where the task plane is; ``start`` (3,) is the planar pose of ee that it begins at (the robot's own
    ready pose by default), ``opening`` [m] that of its fingers. ``on_pose(time, pose)`` is called ``rate`` times a
    second of the robot's time [s] with X_W_ee (3,), in a thread of its own. ``damping`` [s] is the ratio of its joint
    controller's gains, by which it lags behind. ``block`` [m] lets a block of this width float between the fingers.
    ``host`` "" takes a free address.
    """

    def __init__(
        self,
        frames: ArmFrames,
        start: Array | None = None,
        on_pose: Callable[[float, Array], object] = lambda _time, _pose: None,
        rate: float = 250.0,
        host: str = "",
        damping: float = DAMPING,
        opening: float = 0.06,
        block: float = 0.0,
    ):
        if not 0 < rate <= 1000:
            raise ValueError(f"rate: expected a figure in (0, 1000] Hz, received {rate}")
        self.frames = frames
        self.host = host
        self._order = {
            "host": host,
            "start": None if start is None else frames.flange_in_base(np.asarray(start, float)).tolist(),
            "rate": rate,
            "damping": damping,
            "opening": opening,
            "block": block,
        }
        self._on_pose = on_pose
        self._process: subprocess.Popen[bytes] | None = None
        self._pipe: socket.socket | None = None
        self._threads: list[threading.Thread] = []
        self._said: deque[str] = deque(maxlen=50)
        self._arrived = threading.Condition()
        self._newest: tuple[float, Array] | None = None
        self._ended = False

    # -- life --------------------------------------------------------------------------------------------------------

    def __enter__(self) -> Self:
        if importlib.util.find_spec("franky_sim") is None:
            raise NotConnected(
                "franky_sim", "emulate a Franka", "it is not installed", "Run: pip install 'extrinsic[emulators]'"
            )
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._pipe = ours
        self._ended = False
        paths = os.pathsep.join(filter(None, (_HERE, os.environ.get("PYTHONPATH"))))
        try:
            with theirs:
                self._process = process = subprocess.Popen(
                    [sys.executable, "-P", "-m", "drivers.emulators.franka_robot"],
                    env=os.environ | {"PYTHONPATH": paths},
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=subprocess.PIPE,
                    pass_fds=(theirs.fileno(),),
                    start_new_session=True,
                )
                assert process.stdin is not None and process.stdout is not None and process.stderr is not None
                self._spawn(self._hear, process.stderr)
                with suppress(OSError):  # one that has ended at once is told of below
                    process.stdin.write(json.dumps(self._order | {"pipe": theirs.fileno()}).encode() + b"\n")
                    process.stdin.flush()
                self.host = self._await(process.stdout)
            self._spawn(self._look, ours)
        except BaseException:
            self.close()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _spawn(self, run: Callable[..., None], *given: object) -> None:
        thread = threading.Thread(target=run, args=given, name="franka emulator", daemon=True)
        thread.start()
        self._threads.append(thread)

    def _await(self, stdout: IO[bytes]) -> str:
        asked = "emulate a Franka" + (f" at {self.host}" if self.host else "")
        said: dict[str, str] = {}
        deadline = monotonic() + START
        while "ready" not in said:
            if not select.select([stdout], [], [], max(deadline - monotonic(), 0.0))[0]:
                raise NotConnected("franky_sim", asked, f"not ready within {START:g} s", "See what keeps the machine")
            line = stdout.readline()
            if not line:
                got = said.get("error", "it ended: " + "\n".join(self._said))
                raise NotConnected("franky_sim", asked, got, "See that nobody else serves ports 1337 and 1338 there")
            with suppress(ValueError):  # it may say other things before
                said |= json.loads(line)
        return said["ready"]

    def _hear(self, stderr: IO[bytes]) -> None:
        for line in stderr:
            text = line.decode(errors="replace").rstrip()
            self._said.append(text)
            log.info("franky_sim: %s", text)

    def _look(self, pipe: socket.socket) -> None:
        while True:
            try:
                data = pipe.recv(_RECORD_SIZE)
            except OSError:
                break
            if len(data) != _RECORD_SIZE:
                break
            record = np.frombuffer(data)
            pose, _, _ = self.frames.planar(record[1:].reshape(4, 4) @ self.frames.X_F_ee)
            time = float(record[0])
            with self._arrived:
                self._newest = (time, pose)
                self._arrived.notify_all()
            self._on_pose(time, pose)
        with self._arrived:
            self._ended = True
            self._arrived.notify_all()

    def close(self) -> None:
        """End it, and see that it ends; idempotent."""
        process, self._process = self._process, None
        pipe, self._pipe = self._pipe, None
        if process is not None:
            process.send_signal(signal.SIGCONT)
            process.terminate()
            try:
                process.wait(STOP)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        if pipe is not None:
            with suppress(OSError):
                pipe.shutdown(socket.SHUT_RDWR)
        for thread in self._threads:
            thread.join(timeout=STOP)
        self._threads = []
        if pipe is not None:
            pipe.close()
        if process is not None:
            for stream in (process.stdin, process.stdout, process.stderr):
                if stream is not None:
                    with suppress(OSError):
                        stream.close()

    # -- what one does with it ---------------------------------------------------------------------------------------

    def pose(self, timeout: float = 2.0) -> tuple[float, Array]:
        """The robot's time [s] and X_W_ee (3,), as its joints are, at the newest instant. Raises DeviceTimeout."""
        with self._arrived:
            if not self._arrived.wait_for(lambda: self._newest is not None or self._ended, timeout) or not self._newest:
                raise DeviceTimeout("franky_sim", "read the pose", f"nothing within {timeout:g} s", "")
            return self._newest

    def reflex(self) -> None:
        """Let the robot feel a collision: its motion ends, and it moves no more until it is recovered."""
        assert self._pipe is not None, "the emulator is not entered"
        self._pipe.send(b"reflex")

    def kill(self) -> None:
        """Let it die at once, as a robot whose power is cut."""
        assert self._process is not None, "the emulator is not entered"
        self._process.kill()
        self._process.wait()

    def freeze(self) -> None:
        """Let it hang; `thaw` ends that."""
        assert self._process is not None, "the emulator is not entered"
        self._process.send_signal(signal.SIGSTOP)

    def thaw(self) -> None:
        """Let it go on."""
        assert self._process is not None, "the emulator is not entered"
        self._process.send_signal(signal.SIGCONT)
