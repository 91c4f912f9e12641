"""One process per run: a lock on a file in the run's folder, which the kernel takes back when that process dies."""

from __future__ import annotations

import errno
import fcntl
import json
import os
import socket
from pathlib import Path
from types import TracebackType
from typing import Self

from mechanics.yaml_input import InputError, Problem

#: what a file system says that has no locks
_NO_LOCKS = (errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS)


class RunLock:
    """Held while it is entered. Raises InputError when another process holds it, and says which one.

    Its file stays in the folder. A file system without locks goes without: the lock guards against a slip, not a foe.
    """

    def __init__(self, run_folder: Path):
        self.path = run_folder / ".lock"
        self._file = -1

    def __enter__(self) -> Self:
        try:
            self._file = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            wrong = f"cannot be written: {error.strerror}"
            raise InputError([Problem(str(self.path), None, "RUN", wrong, "a folder you may write to")]) from None
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                holder = self._holder()
                self.__exit__(None, None, None)
                expected = "a run that has ended; end that one first (Ctrl-C), or wait for it"
                raise InputError([Problem(str(self.path.parent), None, "RUN", holder, expected)]) from None
        os.truncate(self._file, 0)
        os.pwrite(self._file, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode(), 0)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1

    def _holder(self) -> str:
        try:
            said = json.loads(os.pread(self._file, 1000, 0))
            return f"it still runs, as process {said['pid']} on {said['host']}"
        except (OSError, ValueError, KeyError, TypeError):
            return "another process still runs it"
