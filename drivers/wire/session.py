"""Opens zenoh sessions: peers, clients and the router, with the same settings, and says why one cannot be opened."""

from __future__ import annotations

import atexit
import json
import socket
import ssl
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal
from urllib.parse import SplitResult, urlsplit

import zenoh

from drivers.errors import NotConnected
from drivers.wire.security import Identity

_BATCHES, _VIEW_BATCHES = 16, 8  # of 64 KiB each, made when they are needed
_LOOK = 1.0  # how long looking for the reason of a refusal may take [s]
_CALLBACKS, _LAST = (
    "pyo3-closure",
    2.0,
)  # what zenoh's threads of callbacks are called; how long they may take to end [s]


@atexit.register
def _await_callbacks() -> None:
    """Let the threads end in which zenoh called back, now that every session is closed.

    One that a daemon thread has begun is a daemon, too, and nobody waits for it: the interpreter would end it in the
    midst of zenoh's own code, which aborts the process.
    """
    deadline = time.monotonic() + _LAST
    for thread in threading.enumerate():
        if _CALLBACKS in thread.name and thread.daemon:
            thread.join(max(deadline - time.monotonic(), 0.0))


def address(endpoint: str) -> SplitResult:
    """Host and port of an endpoint like ``tcp/127.0.0.1:7447``."""
    return urlsplit("//" + endpoint.split("/", 1)[1])


def listening(endpoint: str) -> bool:
    """Whether anything accepts connections at an endpoint like ``tcp/127.0.0.1:7447``."""
    where = address(endpoint)
    try:
        with socket.create_connection((where.hostname or "", where.port or 0), timeout=_LOOK):
            return True
    except OSError:
        return False


def settings_of(
    mode: Literal["peer", "client", "router"], endpoint: str, *, listen: bool, keys: tuple[Path, Path, Path] | None
) -> dict[str, Any]:
    """zenoh's settings, by path, for a session that meets others at its endpoint and nowhere else.

    ``keys`` are the files of authority, certificate and private key, for mutual TLS.
    """
    settings: dict[str, Any] = {
        "mode": mode,
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "listen/endpoints": [endpoint] if listen else [],
        "listen/exit_on_failure": True,
        "connect/endpoints": [] if listen else [endpoint],
        "connect/exit_on_failure": True,
    }
    if keys is not None:
        side = "listen" if listen else "connect"
        ca, certificate, key = map(str, keys)
        tls = {
            "root_ca_certificate": ca,
            f"{side}_certificate": certificate,
            f"{side}_private_key": key,
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        }
        settings |= {f"transport/link/tls/{name}": value for name, value in tls.items()}
    return settings


def open_session(
    mode: Literal["peer", "client", "router"],
    endpoint: str,
    *,
    listen: bool,
    timeout: float,
    lease: float,
    identity: Identity | None,
    settings: Mapping[str, Any],
) -> zenoh.Session:
    """A session with these ``settings`` beside our own. Raises NotConnected, with the likely cause."""
    keys = None if identity is None else identity.files
    everything = settings_of(mode, endpoint, listen=listen, keys=keys) | {
        "connect/timeout_ms": int(timeout * 1000),
        "transport/unicast/open_timeout": int(2 * lease * 1000),
        "transport/link/tx/lease": int(lease * 1000),
        # zenoh's own two batches do not hold the pictures of two fingers: their source waits, or a view goes without
        "transport/link/tx/queue/size/data": _BATCHES,
        "transport/link/tx/queue/size/data_low": _VIEW_BATCHES,
        "transport/link/tx/queue/congestion_control/block/wait_before_close": int(lease * 1e6),
        **settings,
    }
    config = zenoh.Config()
    for path, value in everything.items():
        config.insert_json5(path, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        got = str(error).split("at /")[0].strip()
        remedy = "Check bus.endpoint of the station file; another program may have the port"
        if not listen and not listening(endpoint):
            who = "router with `extrinsic lab router" if mode == "client" else "station with `extrinsic serve"
            got, remedy = "nothing listens there", f"Start the {who} STATION`, or correct bus.endpoint"
        elif identity is not None and not listen:
            # to zenoh every refusal is a time-out
            got, remedy = _refusal(endpoint, identity) or (got, remedy)
        raise NotConnected("bus", f"{'listen at' if listen else 'connect to'} {endpoint}", got, remedy) from error


def _refusal(endpoint: str, identity: Identity) -> tuple[str, str] | None:
    """What is wrong and what helps, where a TLS handshake of our own comes to an end that tells it."""
    where, context = address(endpoint), ssl.create_default_context(cafile=identity.ca)
    context.load_cert_chain(identity.certificate, identity.key)
    host = where.hostname or ""
    try:
        with (
            socket.create_connection((host, where.port or 0), timeout=_LOOK) as plain,
            context.wrap_socket(plain, server_hostname=host) as guarded,
        ):
            guarded.recv(1)  # what the router thinks of our certificate comes after the handshake
    except ssl.SSLCertVerificationError as error:
        why = f"the router's certificate cannot be trusted: {error.verify_message}"
        if "mismatch" in error.verify_message:
            return why, f"Use a name that `extrinsic lab init --router-host` was given, not {host}"
        if "expired" in error.verify_message:
            return why, "Renew it with `extrinsic lab renew` and restart the router"
        return why, f"The router is of another lab, or {identity.ca} is: copy the member's folder from this lab"
    except ssl.SSLError as error:
        why = f"the router refused {identity.certificate}: {(error.reason or 'unknown').lower().replace('_', ' ')}"
        return why, "It is of another lab, or a clock is wrong; `extrinsic lab add` makes one of the router's lab"
    except OSError:
        return None
    return None
