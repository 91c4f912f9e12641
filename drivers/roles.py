"""Devices by name, and by what they are in their station."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Generic, TypeVar, cast

from drivers.config import StationConfig
from drivers.errors import NotConnected
from drivers.interfaces import Arm, Device, ForceTorqueSensor, Gripper, TactileSensor, TagCamera

D = TypeVar("D", bound=Device)


class Roles(Mapping[str, Device], Generic[D]):
    """The open devices of the station ``config`` by name; also by role, where it has exactly one of a kind."""

    def __init__(self, config: StationConfig, devices: dict[str, D]):
        self.config = config
        self._devices = devices

    def __getitem__(self, name: str) -> Device:
        return self._devices[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._devices)

    def __len__(self) -> int:
        return len(self._devices)

    @property
    def arm(self) -> Arm:
        """The arm."""
        return cast("Arm", self._only("arm"))

    @property
    def gripper(self) -> Gripper:
        """The gripper."""
        return cast("Gripper", self._only("gripper"))

    @property
    def camera(self) -> TagCamera:
        """The tag camera."""
        return cast("TagCamera", self._only("tag_camera"))

    def force_torque(self, mount: str) -> ForceTorqueSensor:
        """The force/torque sensor that is mounted at ``wrist`` or ``table``."""
        return cast("ForceTorqueSensor", self._only("force_torque", mount))

    def tactile(self, finger: str) -> TactileSensor:
        """The tactile sensor of the ``left`` or ``right`` finger."""
        return cast("TactileSensor", self._only("tactile", finger))

    def _only(self, kind: str, place: str | None = None) -> Device:
        wanted = kind if place is None else f"{kind} at the {place}"
        found = [
            name
            for name, device in self.config.devices.items()
            if device.kind == kind and place in (None, getattr(device, "mount", None), getattr(device, "finger", None))
        ]
        if len(found) != 1:
            got = f"the station has {len(found)} of them" if found else "the station has none"
            raise NotConnected(self.config.name, f"find its {wanted}", got, "Check the devices of the station file")
        return self[found[0]]
