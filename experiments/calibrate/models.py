"""The calibration files as models: what was found, how sure it is, and of what it was found.

Figures are SI unless a name says otherwise. A file says of which devices and objects it is, so that one that belongs
to others is refused by name.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Annotated, Any, Literal, Self
from zlib import crc32

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, model_validator

from mechanics.camera import CameraModel
from mechanics.catalogue import ObjectModel
from mechanics.elasticity import check_positive_definite
from mechanics.readings import Array
from mechanics.yaml_input import Refusal

Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]
Matrix3 = tuple[Vector3, Vector3, Vector3]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _instant(value: Any) -> Any:
    """ISO 8601 text, with its zone, as the instant that it names."""
    if not isinstance(value, str):
        return value
    try:
        instant = datetime.fromisoformat(value)
    except ValueError:
        raise Refusal(f"{value!r} is no instant", "ISO 8601, such as 2026-01-31T12:00:00Z") from None
    return instant if instant.tzinfo is not None else instant.replace(tzinfo=UTC)


class Origin(_Model):
    """Of what, when and by what a calibration was made.

    ``devices`` maps each device that took part to its serial, ``objects`` each role to the object's name and shape
    (see `fingerprint`).
    """

    made: Annotated[datetime, BeforeValidator(_instant)]
    station: str
    world: dict[str, Any] | None = None
    devices: dict[str, str] = Field(default_factory=dict)
    objects: dict[str, str] = Field(default_factory=dict)
    run: str = ""
    revision: str | None = None

    @property
    def age_days(self) -> float:
        """Days since it was made."""
        return (datetime.now(UTC) - self.made).total_seconds() / 86400


class _Calibration(_Model):
    kind: Any
    origin: Origin

    @property
    def name(self) -> str:
        """The file's name without its ending."""
        return self.kind

    @model_validator(mode="after")
    def _can_be_filed(self) -> Self:
        try:
            name = self.name
        except (KeyError, IndexError):
            wrong, expected = "does not say of which objects it is", "the name and shape of each by its role (go, eo)"
            raise Refusal(wrong, expected, at=("origin", "objects")) from None
        if "/" in name or not name.isprintable() or len(name) > 200:
            raise Refusal(f"{name!r:.60} can be no file's name", "names of objects and sensors")
        return self


class ElasticityCalibration(_Calibration):
    """The stiffness of a pair of fingers: w = K x, K in gocf (Tactile Elasticity Characterization).

    ``stiffness`` is what planner and controllers take: the secant at displacements of the size ``amplitude`` [m]. The
    whole law at rest is w = K₀ (1 + stiffening · s) x, with ``initial`` K₀ and s the size of x (`finger_law`);
    ``stiffening`` [1/m], ``hysteresis`` and ``creep`` (shares of K₀) are 0 where the data did not ask for them.
    """

    kind: Literal["elasticity"] = "elasticity"
    sensor: str
    stiffness: Matrix3 = Field(description="K [N/m, N, N·m/rad] in gocf")
    deviation: Matrix3 = Field(description="1 sigma of each entry")
    amplitude: float = Field(ge=0)
    initial: Matrix3
    stiffening: float = 0.0
    hysteresis: float = 0.0
    yield_length: float = 0.0
    creep: float = 0.0
    creep_time: float = 0.0
    offset: Vector3 = Field(description="of the object in the fingers while it was calibrated, in gocf [m, m, rad]")
    residual: Vector3 = Field(description="rms of the wrench's residual [N, N, N·m]")
    chi2: float = Field(ge=0, description="misfit per degree of freedom")
    method: str
    samples: int = Field(ge=1)

    @property
    def name(self) -> str:
        """One file for each sensor and object in it."""
        return f"elasticity-{self.sensor}-{_named(self.origin.objects['go'])}"

    @model_validator(mode="after")
    def _invertible(self) -> Self:
        try:
            check_positive_definite(np.array(self.stiffness))
        except ValueError as error:
            raise Refusal(str(error), "a symmetric, positive definite K", at=("stiffness",)) from None
        return self

    @property
    def K(self) -> Array:
        """K (3, 3)."""
        return np.array(self.stiffness)


def vector3(values: Array) -> Vector3:
    """Three numbers of an array, as a model takes them."""
    a, b, c = values.tolist()
    return a, b, c


def fingerprint(shape: ObjectModel) -> str:
    """An object's name and what tells it from another of the same name: outline and mass."""
    body = f"{shape.vertices_mm} {shape.mass:g}"
    return f"{shape.name} {crc32(body.encode()):08x}"


def _named(print_: str) -> str:
    return print_.split(maxsplit=1)[0]


def tag_name(object_: str, number: int) -> str:
    """The file of tag ``number`` on an object."""
    return f"tag-{object_}-{number}"


def friction_name(pair: str, objects: Mapping[str, str]) -> str:
    """The file of a pair; ``objects`` maps ``go`` and ``eo`` to their fingerprints."""
    bodies = [_named(objects[body]) if body in objects else body for body in pair.split("-")]
    return "friction-" + "-".join(bodies)


class FrictionCalibration(_Calibration):
    """The Coulomb coefficient of a pair of bodies (Friction Model Identification)."""

    kind: Literal["friction"] = "friction"
    pair: Literal["go-ground", "go-eo", "eo-ground"]
    mu: float = Field(gt=0, le=10)
    interval: Vector2 = Field(description="95 % interval")
    samples: int = Field(ge=1)

    @property
    def name(self) -> str:
        """One file for each pair of bodies, by the objects' own names: whichever is held."""
        return friction_name(self.pair, self.origin.objects)


class ForceTorqueCalibration(_Calibration):
    """What hangs on the wrist sensor besides the held object: gripper and fingers."""

    kind: Literal["force_torque"] = "force_torque"
    device: str
    tool_mass: float = Field(ge=0, description="[kg]")
    tool_centre: Vector2 = Field(description="in ee [m]")
    deviation: Vector3 = Field(description="1 sigma of mass [kg] and centre [m]")
    residual: float = Field(ge=0, description="rms of the force's residual [N]")
    samples: int = Field(ge=1)


class TagCalibration(_Calibration):
    """How a tag sits on the grasped object: its planar pose [m, m, rad] in the object's frame, and its 1 sigma."""

    kind: Literal["tag"] = "tag"
    id: int = Field(ge=0)
    pose: Vector3
    deviation: Vector3

    @property
    def name(self) -> str:
        """One file for each tag of an object."""
        return tag_name(_named(self.origin.objects["go"]), self.id)


class CameraCalibration(_Calibration):
    """The tag camera: its lens, and its place in the arm's task plane."""

    kind: Literal["camera"] = "camera"
    device: str
    camera: dict[str, Any] = Field(description="a mechanics.camera.CameraModel as a mapping")
    focal_deviation: float = Field(ge=0, description="1 sigma of the focal length [px]")
    residual_px: float = Field(ge=0, description="rms of the corners")
    views: int = Field(ge=1)

    @model_validator(mode="after")
    def _is_a_camera(self) -> Self:
        try:
            CameraModel.from_dict(self.camera)
        except ValueError as error:
            raise Refusal(str(error), "a camera as calibrate_camera writes it", at=("camera",)) from None
        return self

    @property
    def model(self) -> CameraModel:
        """The camera."""
        return CameraModel.from_dict(self.camera)


class Delay(_Model):
    """How much later than the arm's a device's readings are stamped than they were measured [s], and its 1 sigma."""

    delay: float
    deviation: float = Field(ge=0)


class ClockCalibration(_Calibration):
    """Delays of the streams against the arm's, from a common motion."""

    kind: Literal["clock"] = "clock"
    delays: dict[str, Delay]


Calibration = (
    ElasticityCalibration
    | FrictionCalibration
    | ForceTorqueCalibration
    | CameraCalibration
    | TagCalibration
    | ClockCalibration
)
