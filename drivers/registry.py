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
from importlib.metadata import EntryPoint, entry_points
from typing import TYPE_CHECKING, Any

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
    return (*OURS, *sorted(set(_foreign()) - set(OURS)))


@cache
def driver(name: str) -> Driver:
    """The driver of this name. Raises Refusal where there is none, or its package cannot be imported."""
    if name in OURS:
        return importlib.import_module(OURS[name]).DRIVER
    if name not in (foreign := _foreign()):
        raise Refusal(f"unknown value {name[:60]!r}", one_of(names()), nearest(name, names()), ("driver",))
    entry = foreign[name]
    try:
        found = entry.load()
    except Exception as error:  # somebody else's code: whatever it raises, the user is to know whose it is
        wrong = f"driver {name!r} ({entry.value}) cannot be imported: {type(error).__name__}: {error}"
        raise Refusal(wrong, "a package that is installed as it should be", at=("driver",)) from error
    if not isinstance(found, Driver):
        wrong = f"driver {name!r} ({entry.value}) is a {type(found).__name__}"
        raise Refusal(wrong, "a drivers.registry.Driver", at=("driver",))
    return found


@cache
def _foreign() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}
