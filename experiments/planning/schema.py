"""The plan stage of an experiment file: skill, optimiser, its start, backend, form, weights of the losses, limits."""

from __future__ import annotations

from dataclasses import fields
from functools import cached_property
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, GetJsonSchemaHandler, model_validator
from pydantic_core import CoreSchema

from experiments import registries
from experiments.planning.settings import model_of, optimiser_model
from mechanics.json_schema import Schema, reference, when
from mechanics.yaml_input import Refusal, validated
from planning.problem import Form, Limits, LossWeights, PlanarArm

if TYPE_CHECKING:
    from planning.optimisers.base import Optimiser

Vector2 = tuple[float, float]
Range = tuple[float, float]
Slug = Annotated[str, Field(pattern=r"^[a-z][a-z0-9_]*$", max_length=100)]
DEFAULT_OPTIMISER = "lm"

_WEIGHT = Annotated[float, Field(ge=0, le=1e9)]
WeightsConfig = model_of(
    LossWeights, "WeightsConfig", **{one.name: (_WEIGHT, one.default) for one in fields(LossWeights)}
)


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class WorkspaceConfig(_Model):
    """Where the end-effector may be, [least, largest] each."""

    x: Range = Field(default=(-0.5, 0.5), description="in W [m]")
    y: Range = Field(default=(0.0, 1.0), description="in W [m]")
    angle_deg: Range = Field(default=(-90.0, 90.0), description="in W [deg]")

    @model_validator(mode="after")
    def _rises(self) -> WorkspaceConfig:
        for key in ("x", "y", "angle_deg"):
            _rising(getattr(self, key), key)
        return self


class ArmConfig(_Model):
    """The joints that move an arm in the task plane, as a chain of three: shoulder, elbow, wrist."""

    base: Vector2 = Field(description="the shoulder in W [m]")
    upper: float = Field(gt=0, description="from shoulder to elbow [m]")
    fore: float = Field(gt=0, description="from elbow to wrist [m]")
    tool: Vector2 = Field(default=(0.0, 0.0), description="from the wrist to the end-effector, in its frame [m]")
    elbow: Literal[1, -1] = Field(default=1, description="1: it bends counter-clockwise")
    zero_deg: tuple[float, float, float] = Field(
        default=(0.0, 0.0, 0.0), description="the joints' readings where the chain lies along +x"
    )
    limits_deg: tuple[Range, Range, Range] = Field(description="least and largest reading of each joint")

    @model_validator(mode="after")
    def _rises(self) -> ArmConfig:
        for i, limits in enumerate(self.limits_deg):
            _rising(limits, "limits_deg", i)
        return self

    def arm(self) -> PlanarArm:
        """As the planner has it, SI."""
        return PlanarArm(
            base=np.array(self.base),
            upper=self.upper,
            fore=self.fore,
            tool=np.array(self.tool),
            elbow=self.elbow,
            zero=np.radians(self.zero_deg),
            limits=np.radians(self.limits_deg),
        )


class LimitsConfig(_Model):
    """What a plan must stay within, by log-barriers in its loss; a key that is left out limits nothing."""

    workspace: WorkspaceConfig | None = None
    arm: ArmConfig | None = None
    force: float | None = Field(default=None, gt=0, description="that the sensor takes [N]")
    torque: float | None = Field(default=None, gt=0, description="that the sensor takes [N·m]")

    def limits(self) -> Limits:
        """As the planner has them, SI."""
        space = self.workspace
        return Limits(
            workspace=None if space is None else np.array([space.x, space.y, np.radians(space.angle_deg)]),
            arm=None if self.arm is None else self.arm.arm(),
            force=self.force,
            torque=self.torque,
        )


class StartConfig(_Model):
    """Where the optimiser sets out: the skill's nominal trajectory, every free variable off it by Gaussian noise.

    The noise is drawn from the seed and the plan's name: the same for every optimiser.
    """

    sigma: float = Field(default=0.0, ge=0, le=100, description="1σ, about mm and N; 0: the nominal trajectory itself")
    beta: float = Field(
        default=3.0,
        ge=0,
        le=10,
        description="its power falls as frequency^-beta along the steps, as a sampler's; 0: white",
    )


def _rising(range_: Range, *at: str | int) -> None:
    if not range_[0] < range_[1]:
        raise Refusal(f"{list(range_)} is no range", "[least, largest], the second above the first", at=at)


class PlanStage(_Model):
    """Make a plan with a skill. ``parameters`` are the skill's own, checked by its model, every default filled in.

    ``optimiser`` is a name, or ``name`` with that optimiser's settings; ``backend`` solves the contact programs;
    ``form`` is what the variables are (`planning.problem`); ``weights`` are those of the losses; ``start`` is where the
    optimiser sets out.
    """

    stage: Literal["plan"]
    name: Slug = Field(description="what `execute` calls it")
    skill: str = Field(description="what is done, and in which contact")
    parameters: dict[str, Any] = Field(default_factory=dict, description="the skill's own")
    optimiser: dict[str, Any] = Field(default_factory=dict, description="a name, or a mapping with its settings")
    backend: Literal["fused", "torch", "cvxpylayers"] = Field(
        default="fused", description="what solves the contact programs"
    )
    form: Literal["closed", "paper"] = Field(default="closed", description="what the variables are")
    weights: WeightsConfig = WeightsConfig()  # type: ignore[valid-type]
    limits: LimitsConfig = LimitsConfig()
    start: StartConfig = StartConfig()

    @classmethod
    def submodel(cls, key: str, data: dict[str, Any]) -> type[BaseModel] | None:
        """The model of the skill's parameters or the optimiser's settings, where the data names skill and optimiser."""
        if key == "parameters":
            found = registries.skills().usable([data.get("skill")])
            return next((skill.Parameters for skill in found.values()), None)
        if key == "optimiser":
            found = registries.optimisers().usable([_optimiser_name(data.get("optimiser", {}))])
            return next((optimiser_model(name) for name in found), None)
        return None

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> Schema:
        """As a file has it: parameters by the skill's name, the optimiser by name or with its settings."""
        found = handler.resolve_ref_schema(handler(core))
        properties, skills = found["properties"], registries.skills().usable()
        properties["skill"]["enum"] = sorted(skills)
        found["allOf"] = [
            when({"skill": name}, {"properties": {"parameters": reference(skills[name].Parameters, handler)}})
            for name in sorted(skills)
        ]
        names = {"type": "string", "enum": sorted(registries.optimisers().usable())}
        settings = {name: reference(optimiser_model(name), handler) for name in names["enum"]}
        properties["optimiser"] = {
            **{key: properties["optimiser"][key] for key in ("title", "description")},
            "default": DEFAULT_OPTIMISER,
            "if": {"type": "string"},
            "then": names,
            "else": {
                "type": "object",
                "properties": {"name": {**names, "default": DEFAULT_OPTIMISER}},
                "allOf": [
                    *(when({"name": name}, settings[name]) for name in settings),
                    when({"name": None}, settings[DEFAULT_OPTIMISER]),
                ],
            },
        }
        return found

    @model_validator(mode="before")
    @classmethod
    def _checked_by_skill_and_optimiser(cls, data: Any) -> Any:
        if not isinstance(data, dict):
            return data  # the fields' own errors say it better
        data = {**data, **_with_optimiser(data.get("optimiser", DEFAULT_OPTIMISER))}
        if not isinstance(data.get("skill"), str):
            return data
        skill = registries.skills().named(data["skill"], at=("skill",))
        parameters = data.get("parameters", {})
        if not isinstance(parameters, dict):
            return data
        model = validated(skill.Parameters, parameters, at=("parameters",))
        return {**data, "parameters": model.model_dump(mode="json")}

    @cached_property
    def skill_parameters(self) -> BaseModel:
        """The parameters as the skill's own model."""
        return validated(registries.skills()[self.skill].Parameters, self.parameters, at=("parameters",))

    @property
    def moves_extrinsic(self) -> bool:
        """Whether the skill needs an extrinsic object."""
        return registries.skills()[self.skill].needs_extrinsic

    def make_optimiser(self) -> Optimiser:
        """A fresh optimiser with these settings."""
        return _made(self.optimiser)

    def loss_weights(self) -> LossWeights:
        """As the planner has them."""
        return LossWeights(**self.weights.model_dump())

    def planner_form(self) -> Form:
        """As the planner has it."""
        return Form(self.form)


def _optimiser_name(optimiser: Any) -> Any:
    return optimiser.get("name", DEFAULT_OPTIMISER) if isinstance(optimiser, dict) else optimiser


def _with_optimiser(optimiser: Any) -> dict[str, Any]:
    """``optimiser`` with its name and every default, in a mapping under its key. Raises Refusal."""
    name = _optimiser_name(optimiser)
    if not isinstance(name, str):
        return {"optimiser": optimiser}
    registries.optimisers().named(name, at=("optimiser", "name") if isinstance(optimiser, dict) else ("optimiser",))
    given = optimiser if isinstance(optimiser, dict) else {"name": name}
    settings = validated(optimiser_model(name), given, at=("optimiser",)).model_dump(mode="json")
    try:
        _made(settings)
    except ValueError as error:
        # "gradient: rate: expected …": what follows the field's name is said where the field stands
        *before, last = str(error).split(": ")
        field = next((word for word in before if word in settings), None)
        raise Refusal(last if field else str(error), at=("optimiser", *([field] if field else []))) from None
    return {"optimiser": settings}


def _made(settings: dict[str, Any]) -> Optimiser:
    given = {key: tuple(value) if isinstance(value, list) else value for key, value in settings.items()}
    name = str(given.pop("name"))
    return registries.optimisers()[name](**given)
