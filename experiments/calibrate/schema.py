"""The calibration stages of an experiment file, and which calibration files a run uses."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from mechanics.yaml_input import Refusal

Vector2 = tuple[float, float]
Pair = Literal["go-ground", "go-eo", "eo-ground"]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _rising(range_: Vector2, key: str) -> None:
    if not range_[0] < range_[1]:
        raise Refusal(f"{list(range_)} is no range", "[least, largest], the second above the first", at=(key,))


class CalibrationUse(_Model):
    """Which calibration files the run uses: those of this station (``auto``), ``none``, or those in a folder."""

    source: str = Field(default="auto", min_length=1, max_length=1000)
    max_age_days: float = Field(default=30.0, gt=0, description="an older file is refused")


class ForceTorqueStage(_Model):
    """Weigh gripper and fingers: turn the arm in free air to ``orientations`` angles, and rest at each."""

    stage: Literal["calibrate_force_torque"]
    angle_deg: Vector2 = (-40.0, 40.0)
    orientations: int = Field(default=9, ge=2, le=200)
    seconds: float = Field(default=0.5, gt=0, le=30, description="averaged at each")

    @model_validator(mode="after")
    def _has_a_range(self) -> ForceTorqueStage:
        _rising(self.angle_deg, "angle_deg")
        return self


class ElasticityStage(_Model):
    """Identify K: the object is fixed to the table, the fingers are moved about it (the paper's protocol).

    A third of the samples lie along the axes, the rest at random, each axis between half and all of its amplitude, in
    mixed order, about where the object hangs freely in the fingers. Amplitudes are what makes ``force`` and ``torque``
    by the stiffness that is believed beforehand. Fingers so stiff that the arm's own error would drown that are moved
    by ``least_mm`` and ``least_deg``, or as far as ``most_force`` and ``most_torque`` allow. Each sample comes from
    another side (a via point), and the wrench is read twice in a hold: what differs is creep.
    """

    stage: Literal["calibrate_elasticity"]
    samples: int = Field(default=200, ge=1, le=10_000)
    force: float = Field(default=6.0, gt=0, le=50, description="at the largest displacement along x and y [N]")
    torque: float = Field(default=0.2, gt=0, le=5, description="at the largest turn [N·m]")
    least_mm: float = Field(default=1.5, ge=0, le=20, description="stiff fingers are moved so far, if `most` allows")
    least_deg: float = Field(default=2.0, ge=0, le=20, description="and turned so far")
    most_force: float = Field(default=20.0, gt=0, le=100, description="for that [N]")
    most_torque: float = Field(default=1.5, gt=0, le=10, description="for that [N·m]")
    ramp: float = Field(default=0.25, gt=0, le=10, description="time for each of a sample's two motions [s]")
    dwell: float = Field(default=1.5, ge=0.4, le=60, description="length of a hold [s]")
    long_dwell: float = Field(default=15.0, ge=0.4, le=600, description="of every twentieth hold, for slow creep [s]")


class FrictionStage(_Model):
    """Identify the friction of a pair of bodies from random motions in contact.

    ``go-ground`` drags the held object over the table, ``go-eo`` over the extrinsic object, which is fixed to the
    table, and ``eo-ground`` holds the extrinsic object and drags it over the table.
    """

    stage: Literal["calibrate_friction"]
    pair: Pair
    strokes: int = Field(default=16, ge=1, le=1000)
    force: Vector2 = Field(default=(3.0, 6.0), description="range of the normal force [N]")
    tilt_deg: Vector2 = Field(
        default=(8.0, 20.0), description="range by which the held object leans back from where it is dragged to"
    )
    stroke_mm: float = Field(default=25.0, gt=0, le=200, description="length of a stroke")
    speed: float = Field(default=0.02, gt=0, le=0.2, description="[m/s]")

    @model_validator(mode="after")
    def _has_ranges(self) -> FrictionStage:
        _rising(self.force, "force")
        _rising(self.tilt_deg, "tilt_deg")
        return self


class CameraStage(_Model):
    """Calibrate the tag camera: its lens from a tag board, its place from the tag of the object in the arm's hand."""

    stage: Literal["calibrate_camera"]
    views: int = Field(default=20, ge=1, le=200, description="poses of the board")
    poses: int = Field(default=16, ge=1, le=200, description="poses of the arm")
    frames: int = Field(default=1, ge=1, le=100, description="pictures averaged at each")


class ClockStage(_Model):
    """Find the delays of the streams against the arm's: turn the arm to and fro in free air."""

    stage: Literal["calibrate_clock"]
    angle_deg: float = Field(default=15.0, gt=0, le=60)
    period: float = Field(default=1.0, gt=0.1, le=10, description="of the slowest motion [s]")
    seconds: float = Field(default=6.0, gt=0, le=120)


CalibrationStage = ForceTorqueStage | ElasticityStage | FrictionStage | CameraStage | ClockStage
