"""The experiment file as a model: objects, grasp, sensor, the protocol's figures, and the sequence of stages.

Unknown keys are refused, and every figure that is not SI says so in its name. Whatever a name refers to (an object, a
sensor, a station) is looked up in `experiments.files`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Discriminator,
    Field,
    GetJsonSchemaHandler,
    Tag,
    create_model,
    model_validator,
)
from pydantic_core import CoreSchema

from control.settings import TrialSettings
from experiments import registries
from experiments.calibrate.schema import CalibrationStage, CalibrationUse, FrictionStage, Pair
from experiments.faults.schema import FaultsStage, TimedFault
from experiments.planning.schema import PlanStage, Slug
from mechanics.catalogue import CATALOGUE, SENSORS, ObjectModel, SensorModel
from mechanics.json_schema import Offered, Schema, reference
from mechanics.yaml_input import Refusal, nearest, one_of, validated

Vector2 = tuple[float, float]


def _named_or_inline(value: Any) -> str:
    return "inline" if isinstance(value, dict | BaseModel) else "name"


def _shipped(folder: Path, *more: str) -> Offered:
    """The names of what is shipped in a folder; any other file will do as well."""
    return Offered(lambda: [*more, *(file.stem for file in folder.glob("*.yaml"))], only=False)


_NAME = Field(min_length=1, max_length=1000)
ObjectReference = Annotated[
    Annotated[Annotated[str, _NAME, _shipped(CATALOGUE)], Tag("name")] | Annotated[ObjectModel, Tag("inline")],
    Discriminator(_named_or_inline),
]
SensorReference = Annotated[
    Annotated[Annotated[str, _NAME, _shipped(SENSORS, "auto")], Tag("name")] | Annotated[SensorModel, Tag("inline")],
    Discriminator(_named_or_inline),
]
#: how the name of a plan file ends
PLAN_FILE = ".npz"


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class GraspConfig(_Model):
    """Where the fingers hold the object: X_go_gocf, in the object's frame (origin: its centroid).

    ``auto``: so that an end of a tall box stays in the tactile picture, and for a GelSlim's smaller one a side, too.
    """

    centre_mm: Vector2 | Literal["auto"] = Field(default="auto", description="the grasp centre [mm]")
    angle_deg: float = Field(default=0.0, ge=-180, le=180, description="of the fingers' axes [deg]")


class ReportConfig(_Model):
    """What the report shows. ``playback_rate`` is the frames kept of each second of station time [Hz]."""

    playback_rate: float = Field(default=25.0, gt=0, le=200, description="frames kept of each second [Hz]")


class HealthConfig(_Model):
    """What a checkpoint (before each trial) does while a sensor is not well: ``pause`` until it is, or only ``warn``.

    A paused run is ended as ``device_failed`` after ``limit`` seconds of the station's time. A trial that a device cut
    off is run again, where the device has come back within that time.
    """

    on_fault: Literal["pause", "warn"] = Field(default="pause", description="until it is well, or only tell")
    limit: float = Field(default=30.0, gt=0, le=86400, description="longest pause [s]")


def _known_controllers(names: tuple[str, ...]) -> tuple[str, ...]:
    known = registries.controllers()
    for i, name in enumerate(names):
        known.named(name, at=(i,))
        if name in names[:i]:
            raise Refusal(f"the controller {name!r} stands twice", "each controller once", at=(i,))
    return names


class ExecuteStage(_Model):
    """Run ``trials`` trials of a plan under each controller, numbered from ``first``.

    ``plan`` names an earlier plan stage, or a plan file (``….npz``) that a run has left under its ``plans/``.
    ``settings`` are the laws' figures, by the controller's name.
    """

    stage: Literal["execute"]
    plan: Annotated[str, _NAME] = Field(description="an earlier plan stage's name, or a plan file")
    controllers: Annotated[
        tuple[str, ...],
        Field(min_length=1, description="each runs every trial"),
        AfterValidator(_known_controllers),
        Offered(lambda: registries.controllers().usable()),
    ]
    settings: dict[str, dict[str, Any]] = Field(
        default_factory=dict, description="the laws' figures, by the controller's name"
    )
    restiffen: bool = Field(
        default=False,
        description="end-effector poses anew, from the go's and the forces, by the stiffness believed here",
    )
    trials: int = Field(default=1, ge=1, le=10_000, description="so many under each controller")
    first: int = Field(default=0, ge=0, le=1_000_000, description="number of the first trial: the grasp is drawn by it")
    faults: tuple[TimedFault, ...] = Field(
        default=(), description="what goes wrong in each trial, where the station is simulated, and when"
    )

    @classmethod
    def submodel(cls, key: str, data: dict[str, Any]) -> type[BaseModel] | None:
        """The model of the laws' settings, where ``data`` names controllers."""
        if key != "settings":
            return None
        names = data.get("controllers")
        laws = registries.controllers().usable(names if isinstance(names, list | tuple) else ())
        fields: dict[str, Any] = {name: (law.Settings, law.Settings()) for name, law in laws.items()}
        return create_model("settings", __config__=_Model.model_config, **fields)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> Schema:
        """As a file has it: settings by the laws' own models."""
        found, laws = handler.resolve_ref_schema(handler(core)), registries.controllers().usable()
        models = {name: reference(laws[name].Settings, handler) for name in sorted(laws)}
        settings = found["properties"]["settings"]
        found["properties"]["settings"] = {**settings, "properties": models, "additionalProperties": False}
        return found

    @model_validator(mode="after")
    def _settings_are_the_laws(self) -> ExecuteStage:
        for name, given in self.settings.items():
            if name not in self.controllers:
                wrong = f"{name!r} is none of the stage's controllers"
                raise Refusal(wrong, one_of(self.controllers), nearest(name, self.controllers), at=("settings", name))
            validated(registries.controllers()[name].Settings, given, at=("settings", name))
        return self

    def law(self, name: str) -> Any:
        """The settings of a controller of this stage, as its own model."""
        return validated(registries.controllers()[name].Settings, self.settings.get(name, {}), at=("settings", name))

    @property
    def from_file(self) -> bool:
        """Whether ``plan`` is a file."""
        return self.plan.endswith(PLAN_FILE)


Stage = Annotated[PlanStage | ExecuteStage | FaultsStage | CalibrationStage, Field(discriminator="stage")]


class Experiment(_Model):
    """An experiment: what is held, what it touches, and what is done, in order."""

    name: Slug = Field(description="run folders and reports carry it")
    station: Annotated[str, _shipped(Path(__file__).parent / "stations")] = Field(
        default="sim", min_length=1, max_length=1000, description="the station it runs on: a name, or a file"
    )
    seed: int = Field(default=0, ge=0, lt=2**63, description="of everything that is drawn")
    sensor: SensorReference = Field(
        default="auto", description="the fingers' elasticity: a name, a file, or a mapping; auto: the station's fingers"
    )
    grasped_object: ObjectReference = Field(description="what the fingers hold: a name, a file, or a mapping")
    extrinsic_object: ObjectReference | None = Field(
        default=None, description="what it touches on the table: a name, a file, or a mapping"
    )
    grasp: GraspConfig = GraspConfig()
    friction: dict[Pair, Annotated[float, Field(gt=0, le=10)]] = Field(
        default_factory=dict, description="Coulomb coefficients by pair, where they are not the objects' own"
    )
    calibration: CalibrationUse = CalibrationUse()
    health: HealthConfig = HealthConfig()
    rehearse: bool = Field(default=False, description="the plans' motions in free air in place of trials: --rehearse")
    trial: TrialSettings = Field(default_factory=lambda: TrialSettings.model_validate({}))
    stages: Annotated[tuple[Stage, ...], Field(min_length=1)] = Field(description="what is done, in order")
    report: ReportConfig = ReportConfig()

    @model_validator(mode="after")
    def _stages_follow_each_other(self) -> Experiment:
        plans: list[str] = []
        for i, stage in enumerate(self.stages):
            if isinstance(stage, PlanStage):
                if stage.name in plans:
                    raise Refusal(f"a second plan named {stage.name!r}", "a name of its own", at=("stages", i, "name"))
                plans.append(stage.name)
            elif isinstance(stage, ExecuteStage | FaultsStage) and stage.plan not in plans and not stage.from_file:
                expected = one_of([*plans, "a plan file (.npz)"]) if plans else "a plan stage before it, or a plan file"
                wrong = f"no plan named {stage.plan!r} comes before this stage"
                raise Refusal(wrong, expected, nearest(stage.plan, plans), at=("stages", i, "plan"))
        return self

    @model_validator(mode="after")
    def _skills_find_what_they_move(self) -> Experiment:
        for stage in self.stages:
            if isinstance(stage, PlanStage) and stage.moves_extrinsic and self.extrinsic_object is None:
                wrong = f"missing key: {stage.skill} moves an extrinsic object"
                raise Refusal(wrong, "the name of an object, or a mapping", at=("extrinsic_object",))
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
