"""Ports and a bus of one's own on this machine, for what nobody else is to find."""

from __future__ import annotations

import socket

from drivers.config import BusConfig


def free_port() -> int:
    """A port of 127.0.0.1 that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def free_endpoint() -> str:
    """``tcp/127.0.0.1:PORT`` with a port that was free a moment ago."""
    return f"tcp/127.0.0.1:{free_port()}"


def own_bus(bus: BusConfig) -> BusConfig:
    """The bus at a free endpoint of this machine, without router or keys."""
    return bus.model_copy(update={"endpoint": free_endpoint(), "mode": "peer", "tls": None, "insecure": False})
