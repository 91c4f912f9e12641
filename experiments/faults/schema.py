"""The stage ``faults`` as a model: a matrix of faults and moments, with the outcome that each has to have."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from drivers.fault import Fault
from experiments import registries
from mechanics.json_schema import Offered
from mechanics.yaml_input import Refusal

Moment = Literal["before", "approach", "contact", "logging"]
MOMENTS: tuple[Moment, ...] = ("before", "approach", "contact", "logging")
Status = Literal["completed", "slipped", "lost_contact", "stopped", "diverged", "device_failed"]


class TimedFault(Fault):
    """A fault that happens at a moment of the first trial of an ``execute`` stage; its times count from then.

    ``before`` the approach, at its begin, in ``contact`` in the middle of the trajectory, or while the trial is over
    and its data are written (``logging``).
    """

    moment: Moment


class Cell(BaseModel):
    """A fault, the moments at which it happens, and how the trial may end then; any of several is right."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    fault: Fault
    moments: Annotated[tuple[Moment, ...], Field(min_length=1)] = MOMENTS
    expect: Annotated[dict[Moment, Status | tuple[Status, ...]], Field(min_length=1)]
    stops: bool = Field(
        default=False, description="whether the arm has to stop moving as soon as the fault can be noticed"
    )

    @model_validator(mode="after")
    def _every_moment_has_its_end(self) -> Self:
        for moment in self.moments:
            if moment not in self.expect:
                raise Refusal(f"nothing is said of {moment}", "how the trial ends then", at=("expect",))
        return self

    def expected(self, moment: Moment) -> tuple[Status, ...]:
        """The statuses that are right."""
        found = self.expect[moment]
        return (found,) if isinstance(found, str) else found


def _known_controller(name: str) -> str:
    registries.controllers().named(name)
    return name


class FaultsStage(BaseModel):
    """Run a trial of a plan once for each cell and moment, each in a run folder of its own under ``cells/``.

    A world of its own is started for each: a fault of one is not that of another. Simulated stations only.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)

    stage: Literal["faults"]
    plan: str = Field(min_length=1, max_length=1000)
    controller: Annotated[
        str, AfterValidator(_known_controller), Offered(lambda: registries.controllers().usable())
    ] = Field(default="closed_loop", description="the law of every cell")
    profile: str | None = Field(
        default=None, description="the world's mismatch profile in the cells; the station's own"
    )
    cells: Annotated[tuple[Cell, ...], Field(min_length=1)]

    @property
    def from_file(self) -> bool:
        """False: the plan is one of the same experiment."""
        return False

    @property
    def count(self) -> int:
        """How many cells there are, each moment of a fault being one."""
        return sum(len(cell.moments) for cell in self.cells)
