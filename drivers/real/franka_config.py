"""What a station file says of a Franka arm."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, field_validator

from drivers.config import ArmConfig, RealDevice
from drivers.real.arm_frames import PlaneInBase, ToolMount
from drivers.scene import Strict, Vector3
from mechanics.yaml_input import Refusal

JointStiffness = Annotated[float, Field(gt=0, le=14250)]
Push = Annotated[float, Field(ge=10, le=3000)]
Turn = Annotated[float, Field(ge=1, le=300)]
HOST = r"^[A-Za-z0-9]([A-Za-z0-9.-]*[A-Za-z0-9])?$"


class Load(Strict):
    """What hangs on the flange beyond the end-effector that is set up in Desk."""

    mass: float = Field(gt=0, le=10, description="[kg]")
    centre: Vector3 = Field(default=(0.0, 0.0, 0.0), description="its centre of mass in the flange's frame [m]")
    inertia: Vector3 = Field(default=(0.001, 0.001, 0.001), description="about that, along the flange's axes [kg·m²]")

    @field_validator("inertia")
    @classmethod
    def _of_a_body(cls, inertia: Vector3) -> Vector3:
        a, b, c = sorted(inertia)
        if a <= 0 or c > a + b:
            raise Refusal(f"{inertia} is no body's", "three positive moments, none above the sum of the others")
        return inertia


class FrankaConfig(RealDevice, ArmConfig, frozen=True):
    """A Franka arm, through its control interface (FCI)."""

    driver: Literal["franka"]
    serial: str = Field(default="", description="a label: the interface does not tell the robot's own")
    host: str = Field(default="172.16.0.2", pattern=HOST, description="the robot's address")
    realtime: Literal["enforce", "ignore"] = Field(
        default="enforce", description="whether to refuse a kernel without real time; ignore it for an emulator only"
    )
    plane: PlaneInBase = Field(default=PlaneInBase(), description="where the task plane stands in the robot's base")
    tool: ToolMount = Field(default=ToolMount(), description="how the end-effector's frame sits on the flange")
    out_of_plane_mm: float = Field(default=5.0, gt=0, le=50, description="a commanded arm stands no further out [mm]")
    tilt_deg: float = Field(default=3.0, gt=0, le=30, description="nor is it tilted further out [deg]")
    dynamics: float = Field(default=0.3, gt=0, le=1, description="share of the robot's own speed, acceleration, jerk")
    braking: float = Field(
        default=0.1, ge=0.02, le=0.5, description="without a further set-point it comes to rest within this time [s]"
    )
    impedance: Literal["joint", "cartesian"] = Field(default="joint", description="the robot's own controller")
    joint_stiffness: tuple[JointStiffness, ...] | None = Field(
        default=None, min_length=7, max_length=7, description="of that controller [N·m/rad]; the robot's own by default"
    )
    cartesian_stiffness: tuple[Push, Push, Push, Turn, Turn, Turn] | None = Field(
        default=None, description="of the other one, along and about ee's axes [N/m, N·m/rad]"
    )
    collision_force: float = Field(default=60.0, gt=0, le=200, description="a larger contact force is a reflex [N]")
    collision_torque: float = Field(default=40.0, gt=0, le=87, description="a larger joint torque is a reflex [N·m]")
    load: Load | None = Field(default=None, description="beyond the end-effector set up in Desk; nothing by default")
