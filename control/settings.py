"""The figures of the trial protocol, as they stand under ``trial:`` in an experiment file."""

from __future__ import annotations

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class TrialSettings(BaseModel):
    """How a plan is executed. SI unless the name says otherwise."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    control_rate: float = Field(default=50.0, ge=10, le=1000, description="set-points sent to the arm [Hz]")
    ramp: float = Field(default=0.2, gt=0, le=10, description="duration of the quintic ramp between waypoints [s]")
    speed: float = Field(default=1.0, ge=0.01, le=1, description="share of its speed at which every motion runs")
    settle: float = Field(default=0.1, ge=0, le=10, description="shortest hold at a waypoint [s]")
    settle_timeout: float = Field(default=2.0, gt=0, le=60, description="longest wait for the wrench to rest [s]")
    settle_force: float = Field(default=0.01, gt=0, description="change of the mean from window to window [N]")
    window: float = Field(default=0.1, gt=0, le=2, description="averaging window of the wrench [s]")
    go_pose: Literal["auto", "tags", "tactile"] = Field(
        default="auto",
        description="where controllers learn the grasped object's pose from; auto: from the fingers where their "
        "elasticity with this object is identified, else from the tag",
    )
    tactile_frames: int = Field(default=2, ge=1, le=30, description="pictures of each finger for an estimate")
    tag_frames: int = Field(default=1, ge=1, le=100, description="camera frames averaged per measurement")
    corrections: int = Field(
        default=1,
        ge=0,
        le=10,
        description="feedback updates at a waypoint before it is recorded; where a contact slips, one for the next",
    )
    air_corrections: int = Field(default=3, ge=0, le=20, description="pose updates in free air before touch-down")
    preload: float = Field(default=1.0, gt=0, le=30, description="duration of the force ramp at fixed object pose [s]")
    clearance_mm: float = Field(default=10.0, gt=0, le=200, description="height above touch, before and after")
    approach_speed: float = Field(default=0.05, gt=0, le=0.5, description="mean speed of free motions [m/s]")
    touch_speed: float = Field(default=0.01, gt=0, le=0.1, description="mean speed of the descent to touch [m/s]")
    start_tolerance_mm: float = Field(default=5.0, gt=0, description="farthest the go may start from the plan")
    start_tolerance_deg: float = Field(default=5.0, gt=0, description="and its angle")
    slip_tolerance_mm: float = Field(
        default=0.8, gt=0, description="motion of a contact since touch-down, against its planned mode, that deviates"
    )
    on_deviation: Literal["end", "record"] = Field(
        default="end",
        description="what a slip or a lost contact does: it ends the trial, or is recorded and the trial goes on",
    )
    rehearsal_force: float = Field(
        default=3.0, gt=0, description="force on the grasped object that ends a rehearsal, where it touches nothing [N]"
    )
    force_limit: float = Field(default=30.0, gt=0, description="measured force that ends the trial [N]")
