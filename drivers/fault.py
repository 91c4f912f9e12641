"""A fault of a simulated device, as a station file or a message states it."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf
from typing import Literal, Self

from pydantic import Field, model_validator

from drivers.scene import Strict
from mechanics.yaml_input import Refusal, nearest, one_of

FaultKind = Literal["drop", "freeze", "stuck", "delay", "bias", "saturate", "garbage", "disconnect", "crash"]

#: faults that mean something only for some kinds of device
SUITED: Mapping[str, tuple[str, ...]] = {
    "bias": ("arm", "gripper", "force_torque"),
    "saturate": ("force_torque", "tactile", "tag_camera"),
}
#: lowest and highest ``value`` of the faults that have one; None where it must be given, else its default
_VALUES: Mapping[str, tuple[float, float, float | None, str]] = {
    "drop": (0.0, 1.0, None, "the share of readings that is lost, 0 to 1"),
    "delay": (0.0, 1e3, None, "by how much readings are late [s]"),
    "bias": (-inf, inf, None, "by how much the reading jumps, in its own unit"),
    "saturate": (
        0.0,
        inf,
        None,
        "the end of the range, in the reading's own unit; of a picture in grey levels, or in tenths of a millimetre",
    ),
    "garbage": (0.0, 1.0, 1.0, "the share of messages that is damaged, 0 to 1"),
}


class Fault(Strict):
    """Something that goes wrong with a simulated device.

    It begins ``after`` seconds of station time, counted from the reset (in the station file) or from when it was
    injected, and lasts for ``duration``, or until it is cleared. `drivers.sim.faults` says what each kind does and how
    it shows.
    """

    kind: FaultKind
    device: str = Field(default="world", description="name of a device of the station; a crash takes them all")
    after: float = Field(default=0.0, ge=0, lt=1e9, description="when it begins [s]")
    duration: float | None = Field(default=None, gt=0, lt=1e9, description="how long it lasts [s]")
    value: float | None = Field(default=None, description="how bad it is; what it means depends on the kind")

    @model_validator(mode="after")
    def _has_its_value(self) -> Self:
        if self.kind not in _VALUES:
            if self.value is not None:
                raise Refusal(f"a {self.kind} has no value", "no `value`", at=("value",))
            return self
        low, high, default, meaning = _VALUES[self.kind]
        if self.value is None:
            if default is None:
                raise Refusal("missing key", meaning, at=("value",))
        elif not low <= self.value <= high or self.value in (0.0, inf, -inf):
            raise Refusal(f"the number {self.value:g}", meaning, at=("value",))
        return self

    @property
    def amount(self) -> float:
        """``value``, or its default; 0 for the kinds that have none."""
        if self.value is not None:
            return self.value
        return _VALUES[self.kind][2] or 0.0 if self.kind in _VALUES else 0.0

    def suit(self, devices: Mapping[str, str]) -> None:
        """Raise Refusal unless the fault can befall a station with ``devices``, given with their kinds."""
        if self.kind == "crash":
            return
        if self.device not in devices:
            wrong = f"the station has no device {self.device!r}"
            raise Refusal(wrong, one_of(devices), nearest(self.device, devices), at=("device",))
        kind, suited = devices[self.device], SUITED.get(self.kind)
        if suited is not None and kind not in suited:
            raise Refusal(
                f"'{self.kind}' means nothing for a {kind}", f"a device of kind {one_of(suited)}", at=("kind",)
            )
