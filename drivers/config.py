"""The station file as a model: the simulated world where there is one, the bus, the devices, the tags on the table."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from drivers.fault import Fault
from drivers.scene import Strict, TagMount, Vector3
from mechanics.yaml_input import Refusal

#: after this long without a sign of life somebody counts as dead [s]: ten seconds are too many beside an arm
LEASE = 1.0
#: in lockstep nothing moves meanwhile, and a crowded machine may keep a process waiting for longer than one
LEASE_IN_LOCKSTEP = 10.0


class WorldConfig(Strict):
    """The simulated world. ``profile`` names the mismatch between the plant and what the planner believes of it."""

    profile: str = "ideal"
    stiffness_scale: float = Field(default=1.0, gt=0, description="the plant's stiffness over the planner's")
    friction_scale: dict[Literal["go-ground", "go-eo", "eo-ground"], Annotated[float, Field(gt=0, le=10)]] = Field(
        default_factory=dict, description="the plant's friction over what it was when it was calibrated, by pair"
    )
    clock: Literal["lockstep", "realtime"] = "lockstep"
    timestep: float = Field(default=0.001, gt=0, le=0.002, description="plant step [s]")
    faults: tuple[Fault, ...] = Field(default=(), description="what goes wrong, counted from each reset")


class BusConfig(Strict):
    """Where the station's processes meet."""

    endpoint: str = Field(default="tcp/127.0.0.1:7447", pattern=r"^(tcp|tls)/.+:\d+$")
    timeout: float = Field(default=5.0, gt=0, description="longest wait for a reply [s]")
    lease: float | None = Field(
        default=None,
        gt=0,
        le=60,
        description="who is silent for so long counts as dead [s]; 1 by default, 10 in lockstep, where nothing moves",
    )


class _Device(Strict):
    backend: Literal["sim"] = "sim"
    serial: str = "sim"


class ArmConfig(_Device):
    """A position-controlled arm."""

    kind: Literal["arm"]
    rate: float = Field(default=100.0, gt=0, le=1000)


class GripperConfig(_Device):
    """A two-finger gripper."""

    kind: Literal["gripper"]
    rate: float = Field(default=20.0, gt=0, le=1000)


class ForceTorqueConfig(_Device):
    """A force/torque sensor. ``pose`` is X_ee_sensor for a wrist mount, X_W_sensor for a table mount."""

    kind: Literal["force_torque"]
    mount: Literal["wrist", "table"]
    rate: float = Field(default=1000.0, gt=0, le=1000)
    pose: Vector3 = (0.0, 0.0, 0.0)


class TagCameraConfig(_Device):
    """A camera that sees the tags. ``position`` and ``look_at`` [m] are in the 3-D world (x right, y away, z up)."""

    kind: Literal["tag_camera"]
    rate: float = Field(default=10.0, gt=0, le=60)
    width: int = Field(default=1280, ge=64, le=4096)
    height: int = Field(default=720, ge=64, le=4096)
    focal: float = Field(default=1400.0, gt=0, description="focal length [px]")
    position: Vector3
    look_at: Vector3


def _usual_indentation(given: dict[str, Any]) -> float:
    return 0.0008 if given.get("sensor") == "gelslim" else 0.012


class TactileConfig(_Device):
    """A tactile finger. The ``left`` finger looks along +Y at the task plane, the ``right`` one along −Y.

    ``indentation`` [m] is how deep the held object's face is pressed into the membrane (usually 12 mm) or gel (0.8 mm).
    """

    kind: Literal["tactile"]
    sensor: Literal["soft_bubble", "gelslim"]
    finger: Literal["left", "right"]
    rate: float = Field(default=30.0, gt=0, le=60)
    width: int = Field(default=224, ge=32, le=1280)
    height: int = Field(default=171, ge=32, le=960)
    indentation: float = Field(default_factory=_usual_indentation, gt=0, le=0.03)


DeviceConfig = Annotated[
    ArmConfig | GripperConfig | ForceTorqueConfig | TagCameraConfig | TactileConfig, Field(discriminator="kind")
]


class LogConfig(Strict):
    """What goes into the log: ``omit`` names streams to leave out, ``flush`` its period to disk [s]."""

    omit: tuple[str, ...] = ()
    flush: float = Field(default=0.5, gt=0, le=0.5)


class StationConfig(Strict):
    """A station: its devices, where they meet, and, in simulation, the world behind them."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    world: WorldConfig | None = None
    bus: BusConfig = BusConfig()
    devices: dict[str, DeviceConfig]
    table_tags: tuple[TagMount, ...] = ()
    log: LogConfig = LogConfig()

    @property
    def lease(self) -> float:
        """How long somebody on the bus may be silent before they count as dead [s]."""
        if self.bus.lease is not None:
            return self.bus.lease
        return LEASE_IN_LOCKSTEP if self.world is not None and self.world.clock == "lockstep" else LEASE

    @model_validator(mode="after")
    def _faults_suit(self) -> Self:
        kinds = {name: device.kind for name, device in self.devices.items()}
        for i, fault in enumerate(self.world.faults if self.world is not None else ()):
            try:
                fault.suit(kinds)
            except Refusal as refusal:
                refusal.at = ("world", "faults", i, *refusal.at)
                raise
        return self
