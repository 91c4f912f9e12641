"""The experiment file as a model: objects, grasp, sensor, the protocol's figures, and the sequence of stages.

Unknown keys are refused, and every figure that is not SI says so in its name. Whatever a name refers to (an object, a
sensor, a station) is looked up in `experiments.files`.
"""

from __future__ import annotations

from functools import cached_property
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, Tag, model_validator

from control.settings import TrialSettings
from experiments import registries
from experiments.calibrate.schema import CalibrationStage, CalibrationUse, FrictionStage, Pair
from mechanics.catalogue import ObjectModel, SensorModel
from mechanics.yaml_input import Refusal, nearest, one_of, validated

Vector2 = tuple[float, float]


def _named_or_inline(value: Any) -> str:
    return "inline" if isinstance(value, dict | BaseModel) else "name"


_NAME = Field(min_length=1, max_length=1000)
ObjectReference = Annotated[
    Annotated[Annotated[str, _NAME], Tag("name")] | Annotated[ObjectModel, Tag("inline")],
    Discriminator(_named_or_inline),
]
SensorReference = Annotated[
    Annotated[Annotated[str, _NAME], Tag("name")] | Annotated[SensorModel, Tag("inline")],
    Discriminator(_named_or_inline),
]
Slug = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=100)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class GraspConfig(_Model):
    """Where the fingers hold the object: X_go_gocf, in the object's frame (origin: its centroid)."""

    centre_mm: Vector2 = (0.0, 45.0)
    angle_deg: float = Field(default=0.0, ge=-180, le=180)


class ReportConfig(_Model):
    """What the report shows. ``playback_rate`` is the frames kept of each second of station time [Hz]."""

    playback_rate: float = Field(default=25.0, gt=0, le=200)


class PlanStage(_Model):
    """Make a plan with a skill. ``parameters`` are the skill's own, checked by its model, every default filled in.

    ``backend`` solves the contact programs: cvxpylayers, or the exact projection onto the cones.
    """

    stage: Literal["plan"]
    name: Slug
    skill: str
    backend: Literal["cvxpylayers", "projection"] = "cvxpylayers"
    parameters: dict[str, Any] = Field(default_factory=dict)

    @classmethod
    def submodel(cls, key: str, data: dict[str, Any]) -> type[BaseModel] | None:
        """The model of the skill's parameters, where the data names a skill."""
        skill = data.get("skill")
        if key != "parameters" or not isinstance(skill, str) or skill not in registries.skills():
            return None
        return registries.skills()[skill].Parameters

    @model_validator(mode="before")
    @classmethod
    def _checked_by_the_skill(cls, data: Any) -> Any:
        if not isinstance(data, dict) or not isinstance(data.get("skill"), str):
            return data  # the fields' own errors say it better
        known = registries.skills()
        if data["skill"] not in known:
            name = data["skill"]
            raise Refusal(f"unknown skill {name!r}", one_of(known), nearest(name, known), at=("skill",))
        parameters = data.get("parameters", {})
        if not isinstance(parameters, dict):
            return data
        model = validated(known[data["skill"]].Parameters, parameters, at=("parameters",))
        return {**data, "parameters": model.model_dump(mode="json")}

    @cached_property
    def skill_parameters(self) -> BaseModel:
        """The parameters as the skill's own model."""
        return validated(registries.skills()[self.skill].Parameters, self.parameters, at=("parameters",))


def _known_controllers(names: tuple[str, ...]) -> tuple[str, ...]:
    known = registries.controllers()
    for i, name in enumerate(names):
        if name not in known:
            raise Refusal(f"unknown controller {name!r}", one_of(known), nearest(name, known), at=(i,))
        if name in names[:i]:
            raise Refusal(f"the controller {name!r} stands twice", "each controller once", at=(i,))
    return names


class ExecuteStage(_Model):
    """Run ``trials`` trials of an earlier plan under each controller."""

    stage: Literal["execute"]
    plan: str
    controllers: Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(_known_controllers)]
    trials: int = Field(default=1, ge=1, le=10_000)


Stage = Annotated[PlanStage | ExecuteStage | CalibrationStage, Field(discriminator="stage")]


class Experiment(_Model):
    """An experiment: what is held, what it touches, and what is done, in order."""

    name: Slug
    station: str = Field(default="sim", min_length=1, max_length=1000)
    seed: int = Field(default=0, ge=0, lt=2**63)
    sensor: SensorReference = "soft_bubble"
    grasped_object: ObjectReference
    extrinsic_object: ObjectReference | None = None
    grasp: GraspConfig = GraspConfig()
    friction: dict[Pair, Annotated[float, Field(gt=0, le=10)]] = Field(
        default_factory=dict, description="Coulomb coefficients by pair, where they are not the objects' own"
    )
    calibration: CalibrationUse = CalibrationUse()
    trial: TrialSettings = Field(default_factory=lambda: TrialSettings.model_validate({}))
    stages: Annotated[tuple[Stage, ...], Field(min_length=1)]
    report: ReportConfig = ReportConfig()

    @model_validator(mode="after")
    def _stages_follow_each_other(self) -> Experiment:
        plans: list[str] = []
        for i, stage in enumerate(self.stages):
            if isinstance(stage, PlanStage):
                if stage.name in plans:
                    raise Refusal(f"a second plan named {stage.name!r}", "a name of its own", at=("stages", i, "name"))
                plans.append(stage.name)
            elif isinstance(stage, ExecuteStage) and stage.plan not in plans:
                expected = one_of(plans) if plans else "a plan stage before this one"
                wrong = f"no plan named {stage.plan!r} comes before this stage"
                raise Refusal(wrong, expected, nearest(stage.plan, plans), at=("stages", i, "plan"))
        return self

    @model_validator(mode="after")
    def _friction_names_what_is_there(self) -> Experiment:
        if self.extrinsic_object is None:
            for i, stage in enumerate(self.stages):
                if isinstance(stage, FrictionStage) and "eo" in stage.pair.split("-"):
                    raise Refusal("there is no extrinsic object", "go-ground alone", at=("stages", i, "pair"))
            for pair in self.friction:
                if "eo" in pair.split("-"):
                    raise Refusal("there is no extrinsic object", "go-ground alone", at=("friction", pair))
        return self
