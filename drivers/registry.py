"""The backends of real devices by name: our own, and those of installed packages that announce one.

A package announces a driver by an entry point of the group ``extrinsic.drivers``::

    [project.entry-points."extrinsic.drivers"]
    my_sensor = "my_package.my_sensor:DRIVER"

where ``DRIVER`` is a `Driver`. One of ours by the same name comes first.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING, Any

from mechanics import announced
from mechanics.yaml_input import Refusal, nearest, one_of

if TYPE_CHECKING:  # the station file's model asks here
    from drivers.config import DeviceConfig
    from drivers.interfaces import Device

#: the group of entry points by which packages announce drivers
GROUP = "extrinsic.drivers"

#: ours; nothing of them is imported before a station file names one
OURS = {
    "ati_netft": "drivers.real.ati_netft",
    "franka": "drivers.real.franka",
    "franka_hand": "drivers.real.franka_hand",
    "gelslim_stream": "drivers.real.gelslim_stream",
    "realsense_bubble": "drivers.real.realsense_bubble",
    "tag_camera": "drivers.real.tag_camera",
}


@dataclass(frozen=True)
class Driver:
    """A backend: ``config`` is what the station file says of such a device, ``make(name, config)`` the device, closed.

    Neither may import what an extra brings: a station file is checked on machines that have none of it.
    """

    config: type[DeviceConfig]
    make: Callable[[str, Any], Device]


def names() -> tuple[str, ...]:
    """Every driver that a station file can name, ours first."""
    return (*OURS, *(name for name in announced.names(GROUP) if name not in OURS))


@cache
def driver(name: str) -> Driver:
    """The driver of this name. Raises Refusal where there is none, or its package is not as it should be."""
    if name in OURS:
        return importlib.import_module(OURS[name]).DRIVER
    if name not in (known := names()):
        raise Refusal(f"unknown value {name[:60]!r}", one_of(known), nearest(name, known), ("driver",))
    return announced.load(GROUP, "driver", name, _expected, at=("driver",))


def _expected(found: object) -> str | None:
    return None if isinstance(found, Driver) else "a drivers.registry.Driver"
