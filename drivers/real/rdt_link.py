"""The UDP socket to a Net F/T box: requests out, datagrams in, each with the instant at which it arrived."""

from __future__ import annotations

import socket
import struct
import sys
import time
from contextlib import suppress

from drivers.real import rdt
from drivers.real.rdt import Command

#: more than a datagram of RDT ever has, so that a longer one is seen to be longer
_ROOM = 2048
#: datagrams that wait for us while we are kept waiting [bytes]
_BACKLOG = 1 << 20
#: Linux tells when a datagram arrived, however late we are awake to read it (socket(7), SO_TIMESTAMPNS)
_ARRIVAL = 35
_TIMESPEC = struct.Struct("@ll")


class RdtLink:
    """A link to the box at ``peer`` (address, port), from ``local_port`` of ours; 0: any that is free.

    It is not connected in the socket's sense: what comes from elsewhere is to be seen, and counted. Every method may
    raise OSError.
    """

    def __init__(self, peer: tuple[str, int], local_port: int, patience: float):
        """``patience`` [s] is how long `receive` waits."""
        self._peer, self._patience, self._waits = peer, patience, True
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
                probe.connect(peer)  # sends nothing; tells by which interface the box is reached
                ours = probe.getsockname()[0]
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BACKLOG)
            if sys.platform == "linux":
                with suppress(OSError):
                    self._socket.setsockopt(socket.SOL_SOCKET, _ARRIVAL, 1)
            self._socket.bind((ours, local_port))
            self._socket.settimeout(patience)
        except OSError:
            self._socket.close()
            raise

    def ask(self, command: Command) -> None:
        """Send a request; whether it arrives nobody says."""
        self._socket.sendto(rdt.request(command), self._peer)

    def receive(self, wait: bool = True) -> tuple[bytes, tuple[str, int], int] | None:
        """The next datagram, from where it came, and when [Unix ns]; None where none comes in time.

        Without ``wait`` it is one that is here already.
        """
        try:
            if wait is not self._waits:  # a flag of the call would not do: Python waits before it
                self._socket.settimeout(self._patience if wait else 0.0)
                self._waits = wait
            datagram, ancillary, _, source = self._socket.recvmsg(_ROOM, 64)
        except (TimeoutError, BlockingIOError):
            return None
        return datagram, source, _arrival(ancillary)

    def close(self) -> None:
        """Tell the box to stop, and let go; idempotent."""
        with suppress(OSError):
            self.ask(Command.STOP)
        self._socket.close()


def _arrival(ancillary: list[tuple[int, int, bytes]]) -> int:
    """When a datagram arrived [Unix ns]: as the kernel tells, or now."""
    now = time.time_ns()
    for level, kind, data in ancillary:
        if (level, kind, len(data)) == (socket.SOL_SOCKET, _ARRIVAL, _TIMESPEC.size):
            seconds, nanoseconds = _TIMESPEC.unpack(data)
            return min(now, seconds * 1_000_000_000 + nanoseconds)
    return now
