"""The station file as a model: the simulated world where there is one, the bus, the devices, the tags on the table."""

from __future__ import annotations

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, Self, cast

from pydantic import (
    BaseModel,
    BeforeValidator,
    Field,
    GetJsonSchemaHandler,
    SerializeAsAny,
    create_model,
    model_validator,
)
from pydantic_core import CoreSchema

from drivers.fault import Fault
from drivers.registry import OURS, driver, names
from drivers.scene import Strict, TagMount, Vector3
from mechanics.camera import CameraModel
from mechanics.json_schema import Offered, Schema, reference, when
from mechanics.yaml_input import Refusal, nearest, one_of, validated

#: after this long without a sign of life somebody counts as dead [s]: ten seconds are too many beside an arm
LEASE = 1.0
#: in lockstep nothing moves meanwhile, and a crowded machine may keep a process waiting for longer than one
LEASE_IN_LOCKSTEP = 10.0


def _profiles() -> list[str]:
    return [file.stem for file in (Path(__file__).parent / "sim" / "profiles").glob("*.yaml")]


class WorldConfig(Strict):
    """The simulated world. ``profile`` names the mismatch between the plant and what the planner believes of it."""

    profile: Annotated[str, Offered(_profiles, only=False)] = Field(
        default="ideal", description="how far the plant is from what the planner believes: a name, or a file"
    )
    stiffness_scale: float = Field(default=1.0, gt=0, description="the plant's stiffness over the planner's")
    friction_scale: dict[Literal["go-ground", "go-eo", "eo-ground"], Annotated[float, Field(gt=0, le=10)]] = Field(
        default_factory=dict, description="the plant's friction over what it was when it was calibrated, by pair"
    )
    clock: Literal["lockstep", "realtime"] = Field(
        default="lockstep", description="the same seed gives the same figures; or the wall's pace"
    )
    timestep: float = Field(default=0.001, gt=0, le=0.002, description="plant step [s]")
    faults: tuple[Fault, ...] = Field(default=(), description="what goes wrong, counted from each reset")


class TlsConfig(Strict):
    """Where a station's keys lie: a lab's ``folder`` (`extrinsic lab init`), or three PEM files from elsewhere.

    Paths are relative to the current folder; ``~`` is the home folder.
    """

    folder: str | None = Field(default=None, min_length=1)
    ca: str | None = Field(default=None, min_length=1)
    certificate: str | None = Field(default=None, min_length=1)
    key: str | None = Field(default=None, min_length=1)

    @model_validator(mode="after")
    def _whole(self) -> Self:
        files = {"ca": self.ca, "certificate": self.certificate, "key": self.key}
        given = [name for name, path in files.items() if path is not None]
        if (self.folder is not None and given) or (self.folder is None and len(given) != len(files)):
            raise Refusal("names no complete set of keys", "folder alone, or ca, certificate and key")
        return self


def _usual_mode(given: dict[str, Any]) -> Literal["peer", "client"]:
    return "client" if str(given.get("endpoint", "")).startswith("tls/") else "peer"


class BusConfig(Strict):
    """Where the station's processes meet.

    ``mode`` is ``peer`` on one machine, where the server of the devices listens at ``endpoint``, and ``client`` where a
    router does (the default with ``tls``). ``insecure`` lets a peer listen where other machines can reach it.
    """

    endpoint: str = Field(default="tcp/127.0.0.1:7447", pattern=r"^(tcp|tls)/.+:\d+$")
    mode: Literal["peer", "client"] = Field(default_factory=_usual_mode)
    tls: TlsConfig | None = None
    insecure: bool = Field(default=False, description="whoever reaches the endpoint may command the arm")
    timeout: float = Field(default=5.0, gt=0, description="longest wait for a reply [s]")
    view_rate: float = Field(default=20.0, gt=0, le=100, description="readings per second for who looks on [Hz]")
    image_view_rate: float = Field(default=5.0, gt=0, le=60, description="and pictures [Hz]")
    lease: float | None = Field(
        default=None,
        gt=0,
        le=60,
        description="who is silent for so long counts as dead [s]; 1 by default, 10 in lockstep, where nothing moves",
    )

    @model_validator(mode="after")
    def _guarded(self) -> Self:
        guarded = self.endpoint.startswith("tls/")
        if guarded and self.tls is None:
            expected = "tls: {folder: ...}; `extrinsic lab init` makes them"
            raise Refusal("a tls endpoint needs keys", expected, at=("endpoint",))
        if self.tls is not None and not guarded:
            raise Refusal("keys are of no use at a tcp endpoint", "an endpoint that begins with tls/", at=("tls",))
        if guarded and self.mode == "peer":
            raise Refusal("peers would go round the router and its access rules", "client", at=("mode",))
        if guarded and self.insecure:
            raise Refusal("a tls endpoint is not insecure", "no such key", at=("insecure",))
        return self


class DeviceConfig(BaseModel, frozen=True, extra="forbid"):
    """What a station file says of any device: its ``kind`` (`drivers.interfaces`), and which ``backend`` makes it."""

    kind: str
    backend: Literal["sim", "real", "replay"] = "sim"
    serial: str = "sim"
    rate: float = Field(default=1.0, gt=0, le=1000, description="readings per second [Hz]")


class RealDevice(BaseModel, frozen=True, extra="forbid"):
    """What a station file says of every real device. ``driver`` names who speaks its protocol (`drivers.registry`).

    A driver's own class is its kind's as well: ``class MyConfig(RealDevice, ForceTorqueConfig, frozen=True)``.
    """

    backend: Literal["real"] = "real"
    driver: str
    serial: str = Field(default="", description="the serial number that it must have; any where this is empty")


class ReplayDevice(BaseModel, frozen=True, extra="forbid"):
    """A device whose streams come from a log, with what the log says of it (`drivers.replay`)."""

    backend: Literal["replay"] = "replay"
    log: str = Field(min_length=1, description="a run's folder, or its log")
    stream: str = Field(default="", description="the device's name there; this one's where it is empty")
    speed: float = Field(
        default=1.0, ge=0, allow_inf_nan=False, description="over that of the recording; 0: as fast as it is read"
    )
    loop: bool = Field(default=False, description="whether it begins again at its end")


BACKENDS = ("sim", "real", "replay")

Span = tuple[float, float]


class ArmLimits(Strict):
    """What an arm's server lets pass, and what stops the arm (`drivers.gates`). Cautious: a person stands beside it.

    ``force`` and ``torque`` are of what the wrist's sensor reads, the tool's weight among it unless it was tared away.
    """

    x: Span = Field(default=(-0.4, 0.4), description="workspace of the end-effector [m]")
    y: Span = Field(default=(0.0, 0.6), description="and its height [m]")
    angle_deg: Span = (-100.0, 100.0)
    step_mm: float = Field(default=50.0, gt=0, description="from one set-point to the next")
    step_deg: float = Field(default=30.0, gt=0)
    speed: float = Field(default=0.25, gt=0, description="the reduced speed of ISO 10218 [m/s]")
    turn_speed_deg: float = Field(default=150.0, gt=0, description="[deg/s]")
    acceleration: float = Field(default=4.0, gt=0, description="[m/s²]")
    turn_acceleration_deg: float = Field(default=2000.0, gt=0, description="[deg/s²]")
    age: float = Field(default=0.2, gt=0, description="how long a set-point may be under way [s]")
    force: float = Field(default=40.0, gt=0, description="stops the arm [N]")
    torque: float = Field(default=5.0, gt=0, description="stops the arm [N·m]")
    jump: float = Field(default=8.0, gt=0, description="change of force at once, in mid-motion, that stops it [N]")
    silence: float | None = Field(
        default=None,
        gt=0,
        description="how long the wrist's sensor may be silent [s]; three of its periods, 20 ms at least in real time",
    )
    hold_after: float = Field(default=0.1, gt=0, description="silence of a commander in mid-motion: hold [s]")
    stop_after: float = Field(default=1.0, gt=0, description="and then: stop [s]")

    @model_validator(mode="after")
    def _in_order(self) -> Self:
        for name in ("x", "y", "angle_deg"):
            low, high = getattr(self, name)
            if not low < high:
                raise Refusal(f"{low:g} to {high:g} is no span", "the smaller figure first", at=(name,))
        if self.stop_after < self.hold_after:
            raise Refusal("it would stop before it holds", "stop_after of at least hold_after", at=("stop_after",))
        return self


class ArmConfig(DeviceConfig, frozen=True):
    """A position-controlled arm."""

    kind: Literal["arm"]
    rate: float = Field(default=100.0, gt=0, le=1000)
    limits: ArmLimits = ArmLimits()


class GripperConfig(DeviceConfig, frozen=True):
    """A two-finger gripper."""

    kind: Literal["gripper"]
    rate: float = Field(default=20.0, gt=0, le=1000)


class ForceTorqueConfig(DeviceConfig, frozen=True):
    """A force/torque sensor. ``pose`` is X_ee_sensor for a wrist mount, X_W_sensor for a table mount."""

    kind: Literal["force_torque"]
    mount: Literal["wrist", "table"]
    rate: float = Field(default=1000.0, gt=0, le=1000)
    pose: Vector3 = (0.0, 0.0, 0.0)


class TagCameraConfig(DeviceConfig, frozen=True):
    """A camera that sees the tags. ``position`` and ``look_at`` [m] are in the 3-D world (x right, y away, z up)."""

    kind: Literal["tag_camera"]
    rate: float = Field(default=10.0, gt=0, le=60)
    width: int = Field(default=1280, ge=64, le=4096)
    height: int = Field(default=720, ge=64, le=4096)
    focal: float = Field(default=1400.0, gt=0, description="focal length [px]")
    position: Vector3
    look_at: Vector3

    @property
    def model(self) -> CameraModel:
        """The camera as it is described here. Raises ValueError where it looks nowhere, or straight up or down."""
        return CameraModel.looking_at(self.position, self.look_at, self.focal, self.width, self.height)


def _usual_indentation(given: dict[str, Any]) -> float:
    return 0.0008 if given.get("sensor") == "gelslim" else 0.012


class TactileConfig(DeviceConfig, frozen=True):
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


SIMULATED: dict[str, type[DeviceConfig]] = {
    "arm": ArmConfig,
    "gripper": GripperConfig,
    "force_torque": ForceTorqueConfig,
    "tag_camera": TagCameraConfig,
    "tactile": TactileConfig,
}
"""What the station file says of a simulated device, by kind."""

REPLAYED: dict[str, type[DeviceConfig]] = {
    kind: cast("type[DeviceConfig]", create_model(f"Replayed{model.__name__}", __base__=(ReplayDevice, model)))
    for kind, model in SIMULATED.items()
}
"""And of one that is played back."""


def device_model(data: Any) -> type[DeviceConfig]:
    """What a device's entry in a station file is an entry of. Raises Refusal where it does not say."""
    if not isinstance(data, dict):
        return DeviceConfig
    backend = data.get("backend", "sim")
    if backend == "real":
        return driver(_word(data, "driver", names())).config
    if backend not in BACKENDS:
        raise Refusal(
            f"unknown value {str(backend)[:60]!r}", one_of(BACKENDS), nearest(str(backend), BACKENDS), ("backend",)
        )
    return (REPLAYED if backend == "replay" else SIMULATED)[_word(data, "kind", SIMULATED)]


def _word(data: dict[str, Any], key: str, options: Collection[str]) -> str:
    if key not in data:
        raise Refusal("missing key", f"the kind of this entry under {key!r}: {one_of(options)}", at=(key,))
    found = data[key]
    if not isinstance(found, str) or found not in options:
        raise Refusal(f"unknown value {str(found)[:60]!r}", one_of(options), nearest(str(found), options), at=(key,))
    return found


def _device(data: Any) -> DeviceConfig:
    return data if isinstance(data, DeviceConfig) else validated(device_model(data), data, at=())


class _AnyDevice:
    """The schema of a device's entry: by its kind, or by its driver. Of drivers of other packages nothing is known."""

    @staticmethod
    def __get_pydantic_json_schema__(_core: CoreSchema, handler: GetJsonSchemaHandler) -> Schema:
        known = {name: driver(name).config for name in OURS}
        return {
            "type": "object",
            "properties": {
                "kind": {"type": "string", "enum": list(SIMULATED)},
                "backend": {"type": "string", "enum": list(BACKENDS), "default": "sim"},
                "driver": {"anyOf": [{"enum": list(OURS)}, {"type": "string"}]},
            },
            "required": ["kind"],
            "allOf": [
                *(when({"kind": kind, "backend": None}, reference(SIMULATED[kind], handler)) for kind in SIMULATED),
                *(when({"kind": kind, "backend": "sim"}, reference(SIMULATED[kind], handler)) for kind in SIMULATED),
                *(when({"kind": kind, "backend": "replay"}, reference(REPLAYED[kind], handler)) for kind in REPLAYED),
                when({"backend": "real"}, {"required": ["driver"]}),
                *(when({"backend": "real", "driver": name}, reference(known[name], handler)) for name in known),
            ],
        }


class LogConfig(Strict):
    """What goes into the log: ``omit`` names streams to leave out, ``flush`` its period to disk [s]."""

    omit: tuple[str, ...] = ()
    flush: float = Field(default=0.5, gt=0, le=0.5)


class StationConfig(Strict):
    """A station: its devices, where they meet, and, in simulation, the world behind them."""

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$", description="topics and calibration files carry it")
    world: WorldConfig | None = Field(default=None, description="the simulated world, where there is one")
    bus: BusConfig = BusConfig()
    devices: dict[str, Annotated[SerializeAsAny[DeviceConfig], BeforeValidator(_device), _AnyDevice]] = Field(
        description="each device by its name"
    )
    table_tags: tuple[TagMount, ...] = Field(default=(), description="AprilTags on the table, in W [m]")
    log: LogConfig = LogConfig()

    @property
    def simulated(self) -> bool:
        """Whether every device is simulated; one with a world whose devices are real is an emulated lab."""
        return self.world is not None and all(device.backend == "sim" for device in self.devices.values())

    @property
    def lease(self) -> float:
        """How long somebody on the bus may be silent before they count as dead [s]."""
        if self.bus.lease is not None:
            return self.bus.lease
        return LEASE_IN_LOCKSTEP if self.world is not None and self.world.clock == "lockstep" else LEASE

    @classmethod
    def submodel(cls, key: str, data: dict[str, Any]) -> type[BaseModel] | None:
        """What stands under ``devices``, which only its data can tell (`mechanics.model_paths`)."""
        entries = data.get(key)
        if key != "devices" or not isinstance(entries, dict):
            return None
        fields: dict[str, Any] = {}
        for name, entry in entries.items():
            with suppress(Refusal):
                fields[name] = (device_model(entry), ...)
        return create_model("devices", **fields)

    @model_validator(mode="after")
    def _of_one_making(self) -> Self:
        backends = {name: device.backend for name, device in self.devices.items()}
        if self.world is not None and not self.simulated:
            other = [name for name, backend in backends.items() if backend != "real"]
            if other:
                wrong = f"in an emulated lab every device is real, and {', '.join(other)} is not"
                raise Refusal(wrong, "backend: real, or sim for all of them", at=("devices", other[0]))
            if self.world.clock != "realtime":
                wrong = "real protocols know no lockstep"
                raise Refusal(wrong, "clock: realtime", at=("world", "clock"))
        return self

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
