"""A bus of one's own on this machine, for stations that nobody else is to find."""

from __future__ import annotations

import socket

from drivers.config import BusConfig


def free_endpoint() -> str:
    """``tcp/127.0.0.1:PORT`` with a port that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def own_bus(bus: BusConfig) -> BusConfig:
    """The bus at a free endpoint of this machine, without router or keys."""
    return bus.model_copy(update={"endpoint": free_endpoint(), "mode": "peer", "tls": None, "insecure": False})
