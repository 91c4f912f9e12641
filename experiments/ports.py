"""A free endpoint on this machine, for stations that nobody else is to find."""

from __future__ import annotations

import socket


def free_endpoint() -> str:
    """``tcp/127.0.0.1:PORT`` with a port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"
