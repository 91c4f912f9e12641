"""What can go wrong with a device, as types with fields.

Every message says which device, what was asked, what came back, and what the user can do.
"""

from __future__ import annotations


class DriverError(Exception):
    """A device could not do what was asked of it.

    Fields: ``device``, ``asked`` (what was asked), ``got`` (what came back), ``remedy`` (what the user can do).
    """

    def __init__(self, device: str, asked: str, got: str, remedy: str = ""):
        self.device, self.asked, self.got, self.remedy = device, asked, got, remedy
        super().__init__(device, asked, got, remedy)

    def __str__(self) -> str:
        text = f"{self.device}: {self.asked}: {self.got}"
        return f"{text}. {self.remedy}" if self.remedy else text


class NotConnected(DriverError):
    """The device is not open. ``children`` holds the failures of its parts, one each."""

    def __init__(self, device: str, asked: str, got: str, remedy: str = "", children: tuple[DriverError, ...] = ()):
        super().__init__(device, asked, got, remedy)
        self.children = children

    def __str__(self) -> str:
        lines = [super().__str__()]
        for child in self.children:
            lines += ["  " + line for line in str(child).splitlines()]
        return "\n".join(lines)


class DeviceTimeout(DriverError):
    """Nothing came in time."""


class CommandRefused(DriverError):
    """The device is well and said no; ``reason`` says why."""

    def __init__(self, device: str, asked: str, reason: str, remedy: str = ""):
        super().__init__(device, asked, f"refused: {reason}", remedy)
        self.reason = reason


class DeviceFault(DriverError):
    """The device failed. ``recoverable`` tells whether ``recover`` can help."""

    def __init__(self, device: str, asked: str, got: str, remedy: str = "", recoverable: bool = False):
        super().__init__(device, asked, got, remedy)
        self.recoverable = recoverable


class SimulationDiverged(DeviceFault):
    """The simulated world's state has become nonsense; it stays so until its next reset."""


class ProtocolError(DriverError):
    """Bytes arrived that mean nothing."""
