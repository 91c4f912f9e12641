"""Stop and recover a station's arms from any process that may: no lease, no other device, no agreement on the station.

A stop takes the shortest way: it needs the bus and the arm's server, and nothing else. Whoever stands beside the robot
uses the robot's own emergency stop.
"""

from __future__ import annotations

import getpass
import socket
from collections.abc import Callable
from dataclasses import dataclass

from drivers.config import StationConfig
from drivers.errors import DriverError, NotConnected
from drivers.wire.client import RemoteArm
from drivers.wire.link import Link
from drivers.wire.station_bus import station_bus

#: how long each arm may take to answer [s]
_ANSWER = 2.0


@dataclass(frozen=True)
class ArmState:
    """An arm that was asked, and why it is stopped, or was until now."""

    name: str
    reason: str


def stop(config: StationConfig) -> list[ArmState]:
    """Stop every arm of a station, until `recover`. Raises NotConnected with one child for each that did not answer."""
    asker = f"`extrinsic stop` by {_user()}@{socket.gethostname()}"

    def verb(arm: RemoteArm) -> str:
        arm.stop(asker)
        return arm.safety()["stopped"]

    return _ask(config, "stop its arms", "Use the robot's own emergency stop", verb)


def recover(config: StationConfig) -> list[ArmState]:
    """Release the latched stop of every arm of a station; nothing moves by that. Raises as `stop`."""

    def verb(arm: RemoteArm) -> str:
        reason = arm.safety()["stopped"]
        arm.recover()
        return reason

    return _ask(config, "recover its arms", "Check `extrinsic status STATION`", verb)


def _ask(config: StationConfig, asked: str, remedy: str, verb: Callable[[RemoteArm], str]) -> list[ArmState]:
    names = [name for name, device in config.devices.items() if device.kind == "arm"]
    if not names:
        raise NotConnected(config.name, asked, "the station has no arm", "Check its file")
    done: list[ArmState] = []
    failures: list[DriverError] = []
    with station_bus(config, "runner") as bus:
        link = Link(bus, config.name)
        for name in names:
            arm = RemoteArm(name, link, lockstep=False)
            try:
                arm.connect(_ANSWER)
                done.append(ArmState(name, verb(arm)))
            except DriverError as error:
                failures.append(error)
            finally:
                arm.close()
    if failures:
        failed = f"{len(failures)} of {len(names)} failed"
        raise NotConnected(config.name, asked, failed, remedy, children=tuple(failures))
    return done


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # an account without a name
        return "somebody"
