"""A lab of several machines behind a router in TLS mode: an arm on one, a sensor on another, a runner revoked."""

from __future__ import annotations

from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

from drivers.config import StationConfig
from drivers.wire.access import Access
from drivers.wire.bus import Bus
from drivers.wire.client import RemoteArm
from drivers.wire.link import Link
from drivers.wire.router import Router
from drivers.wire.security import Identity, read_identity

MEMBERS = ("router", "device-bench", "device-shelf", "runner-alice", "runner-bob", "runner-carol", "viewer-wall")
ACCESS = Access(
    station="lab",
    machines={"bench": ("arm", "world"), "shelf": ("wrist_ft",)},
    runners=("alice", "bob", "carol"),
    viewers=("wall",),
).without("runner-bob")


class Lab:
    """A router, and a way onto its bus for each member."""

    def __init__(self, keys: Path, endpoint: str, stack: ExitStack):
        self.keys, self._stack = keys, stack
        self.config = StationConfig.model_validate(
            {
                "name": "lab",
                "bus": {"endpoint": endpoint.replace("tcp/", "tls/"), "tls": {"folder": str(keys)}, "timeout": 5.0},
                "devices": {"arm": {"kind": "arm"}, "wrist_ft": {"kind": "force_torque", "mount": "wrist"}},
            }
        )
        self.router = stack.enter_context(Router(self.config, ACCESS, self.identity("router")))

    @property
    def endpoint(self) -> str:
        return self.config.bus.endpoint

    def identity(self, name: str) -> Identity:
        return read_identity(*(self.keys / name / file for file in ("ca.pem", "certificate.pem", "key.pem")))

    def unchecked(self, name: str) -> Identity:
        """An identity that our own side has not looked at: the router is to judge it."""
        files = {part: self.keys / name / f"{part}.pem" for part in ("ca", "certificate", "key")}
        return replace(self.identity("runner-alice"), **files)

    def bus(self, name: str) -> Bus:
        return self._stack.enter_context(
            Bus(self.endpoint, mode="client", shared_memory=False, identity=self.identity(name))
        )

    def arm(self, name: str) -> RemoteArm:
        arm = RemoteArm("arm", Link(self.bus(name), "lab"), lockstep=False)
        arm.connect(5.0)
        self._stack.callback(arm.close)
        return arm
