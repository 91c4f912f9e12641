"""The table file as a model: calibrations, runs, panels, comparisons, and what is held against targets.

Nothing here knows a table. A trial is told by its *tags*: those that a run gives it (``tags``), and `ALWAYS`, which
every trial has. Panels, comparisons and counts pick trials by tags.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from experiments import registries
from experiments.planning.schema import Slug
from mechanics.json_schema import Offered
from mechanics.yaml_input import Refusal, nearest, one_of

#: what a figure may be: one of design §6's (of every trial), a summary of the paper's Table 3, or a plan's
ERRORS = {
    "wrench_N": "wrench [N]",
    "go_pose_mm": "go pose [mm]",
    "eo_pose_mm": "eo pose [mm]",
    "fx_N": "fx [N]",
    "fy_N": "fy [N]",
    "tau_Nmm": "τ [N·mm]",
    "x_mm": "x [mm]",
    "y_mm": "y [mm]",
    "theta_deg": "θ [°]",
}
SUMMARIES = {"wrench_summary_N": "wrench* [N]", "pose_summary_mm": "pose* [mm]"}
PLANS = {"plan_time_s": "planning [s]", "plan_loss": "loss"}
HEADINGS = {**ERRORS, **SUMMARIES, **PLANS}

#: tags that every trial has
ALWAYS = ("run", "trajectory", "controller", "sensor", "mu_ground", "mu_object")

#: what a table keeps of trials and plans besides their tags
KEPT = ("job", "trial", "status", "reason", "deviation", "rho_mm", "file", "queries", *PLANS)

Tag = str | float | int
Where = dict[str, Tag | tuple[Tag, ...]]
Settings = dict[str, Any]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


def _known_figures(names: tuple[str, ...]) -> tuple[str, ...]:
    for i, name in enumerate(names):
        if name not in HEADINGS:
            raise Refusal(f"unknown figure {name!r}", one_of(HEADINGS), nearest(name, HEADINGS), at=(i,))
    return names


def _known_figure(name: str) -> str:
    if name not in HEADINGS:
        raise Refusal(f"unknown figure {name!r}", one_of(HEADINGS), nearest(name, HEADINGS))
    return name


def _of_trials(name: str) -> str:
    if name in HEADINGS and name not in ERRORS:
        raise Refusal(f"a trial alone has no {name}: there are no pairs of it", one_of(ERRORS), nearest(name, ERRORS))
    return _known_figure(name)


def _known_controllers(names: tuple[str, ...]) -> tuple[str, ...]:
    known = registries.controllers()
    for i, name in enumerate(names):
        known.named(name, at=(i,))
    return names


Figure = Annotated[str, AfterValidator(_known_figure), Offered(lambda: HEADINGS)]
TrialFigure = Annotated[str, AfterValidator(_of_trials), Offered(lambda: ERRORS)]
Figures = Annotated[tuple[str, ...], Field(min_length=1), AfterValidator(_known_figures), Offered(lambda: HEADINGS)]
Controllers = Annotated[
    tuple[str, ...], AfterValidator(_known_controllers), Offered(lambda: registries.controllers().usable())
]


class CalibrationEntry(_Model):
    """An experiment of calibration stages; it begins with what the entry named in ``after`` has found."""

    name: Slug
    experiment: str = Field(default="calibrate", min_length=1)
    station: str | None = None
    after: str | None = Field(default=None, description="an entry before this one")
    set: Settings = Field(default_factory=dict)


class Trajectory(_Model):
    """One of the trajectories of a run: what it sets differently."""

    name: str = Field(min_length=1, max_length=100, pattern=r"^[A-Za-z0-9_]+$")
    set: Settings = Field(default_factory=dict)


class RunEntry(_Model):
    """Trials of one experiment: each of its ``trajectories`` ``trials`` times under each of the ``controllers``.

    The n-th trajectory's trials are numbered from n × ``trials``, so that each grasps anew. Without controllers it is
    planned only. ``plans_of`` names a run whose saved plans are executed instead, trajectory by trajectory, the
    end-effector's poses worked out anew for the stiffness that this run believes.
    """

    name: Slug
    experiment: str = Field(min_length=1)
    station: str | None = None
    calibration: str | None = Field(default=None, description="an entry of `calibrations`; none: nominal figures")
    plans_of: str | None = None
    tags: dict[Slug, Tag] = Field(default_factory=dict)
    set: Settings = Field(default_factory=dict)
    controllers: Controllers | None = None
    trials: int | None = Field(default=None, ge=1, le=1000)
    trajectories: tuple[Trajectory, ...] | None = None


class Panel(_Model):
    """A grid of figures: a row for each value of the ``rows`` tags, a column for each figure and ``across`` tags."""

    title: str = ""
    rows: Annotated[tuple[str, ...], Field(min_length=1)]
    across: tuple[str, ...] = ()
    figures: Figures
    where: Where = Field(default_factory=dict)


class Comparison(_Model):
    """``a`` − ``b`` in a figure, for each value of ``each``, over pairs of trials of one number.

    The trials of a pair are alike in every tag but those that ``a`` or ``b`` sets, and those that follow from them: the
    run, where a's trials are of other runs than b's.

    The ``judged`` one of mean, ``upper`` and ``lower`` end of its 95 % interval is held against the target. A target of
    at most 0 is met by the upper end where a is surely not above b, and by the lower end even where nobody can tell:
    there the upper end says how far above it could be.
    """

    name: str = Field(min_length=1)
    figure: TrialFigure
    each: tuple[str, ...] = ()
    where: Where = Field(default_factory=dict)
    a: Where
    b: Where
    judged: Literal["mean", "upper", "lower"] = "upper"


class Count(_Model):
    """How many cells of the panels are on the asked side of the paper's figure, or how many trials were completed."""

    name: str = Field(min_length=1)
    of: Literal["cells at or below the paper", "cells at or above the paper", "trials completed"]
    where: Where = Field(default_factory=dict)
    figures: Figures | None = None


class Single(_Model):
    """One mean."""

    name: str = Field(min_length=1)
    figure: Figure
    where: Where


class Paper(_Model):
    """Where the paper's figures stand in `paper_tables.yaml`, ``{tag}`` by tag; ``stand_in``: which of its rows stands
    beside ours where it has none of that name."""

    at: str = Field(min_length=1)
    stand_in: dict[str, dict[str, str]] = Field(default_factory=dict)


class Table(_Model):
    """A table: what is run, in the order calibrations, runs, and what is made of the trials."""

    name: Slug
    title: str
    notes: tuple[str, ...] = ()
    set: Settings = Field(default_factory=dict)
    calibrations: tuple[CalibrationEntry, ...] = ()
    controllers: Controllers = ()
    trials: int = Field(default=1, ge=1, le=1000)
    trajectories: tuple[Trajectory, ...] = ()
    runs: Annotated[tuple[RunEntry, ...], Field(min_length=1)]
    panels: Annotated[tuple[Panel, ...], Field(min_length=1)]
    comparisons: tuple[Comparison, ...] = ()
    counts: tuple[Count, ...] = ()
    figures: tuple[Single, ...] = ()
    paper: Paper | None = None

    @model_validator(mode="after")
    def _names_are_known(self) -> Table:
        self._each_once_and_after("calibrations", self.calibrations, "after")
        self._each_once_and_after("runs", self.runs, "plans_of")
        self._plans_are_there()
        known = [entry.name for entry in self.calibrations]
        for i, run in enumerate(self.runs):
            if run.calibration is not None and run.calibration not in known:
                wrong = f"no calibration is named {run.calibration!r}"
                raise Refusal(wrong, one_of(known), nearest(run.calibration, known), at=("runs", i, "calibration"))
        names = [name for name, _ in self._judged()]
        for i, name in enumerate(names):
            if name in names[:i]:
                raise Refusal(f"{name!r} stands twice", "a name of its own for everything that is judged")
        return self

    def _each_once_and_after(self, key: str, entries: tuple[Any, ...], other: str) -> None:
        before: list[str] = []
        for i, entry in enumerate(entries):
            if entry.name in before:
                raise Refusal(f"{entry.name!r} stands twice", "a name of its own", at=(key, i, "name"))
            named = getattr(entry, other)
            if named is not None and named not in before:
                expected = one_of(before) if before else "none: this is the first"
                wrong = f"{named!r} does not stand before this one"
                raise Refusal(wrong, expected, nearest(named, before), at=(key, i, other))
            before.append(entry.name)

    def _plans_are_there(self) -> None:
        """A run whose saved plans are executed makes its own, for each trajectory."""
        runs = {run.name: run for run in self.runs}
        for i, run in enumerate(self.runs):
            if run.plans_of is None:
                continue
            planner, at = runs[run.plans_of], ("runs", i, "plans_of")
            planning = one_of(name for name, other in runs.items() if other.plans_of is None)
            if planner.plans_of is not None:
                raise Refusal(f"{planner.name} executes plans of {planner.plans_of}, it makes none", planning, at=at)
            if not self.controllers_of(run):
                raise Refusal("without controllers nobody executes the plans", "`controllers`", at=at)
            made = [trajectory.name for trajectory in self.trajectories_of(planner)]
            for trajectory in self.trajectories_of(run):
                if trajectory.name not in made:
                    wrong = f"{planner.name} has no trajectory {trajectory.name!r}"
                    raise Refusal(wrong, one_of(made), nearest(trajectory.name, made), at=at)

    def _judged(self) -> Iterator[tuple[str, Any]]:
        for entry in (*self.comparisons, *self.counts, *self.figures):
            yield entry.name, entry

    @model_validator(mode="after")
    def _tags_are_given(self) -> Table:
        for i, run in enumerate(self.runs):
            for tag in run.tags:
                if tag in (*ALWAYS, *KEPT):
                    wrong = f"every trial has its own {tag!r} already"
                    raise Refusal(wrong, "another name for a tag of your own", at=("runs", i, "tags", tag))
        given = self.tags
        for key in ("panels", "comparisons", "counts", "figures"):
            for i, entry in enumerate(getattr(self, key)):
                for name in _tag_fields(entry):
                    for tag in getattr(entry, name):
                        if tag not in given:
                            wrong = f"no run has the tag {tag!r}"
                            raise Refusal(wrong, one_of(given), nearest(tag, given), at=(key, i, name))
        return self

    @property
    def tags(self) -> tuple[str, ...]:
        """Every tag that tells trials of this table apart, each once."""
        return tuple(dict.fromkeys((*ALWAYS, *(tag for run in self.runs for tag in run.tags))))

    def controllers_of(self, run: RunEntry) -> tuple[str, ...]:
        """Its own, or the table's."""
        return self.controllers if run.controllers is None else run.controllers

    def trials_of(self, run: RunEntry) -> int:
        """Trials of each of its trajectories."""
        return self.trials if run.trials is None else run.trials

    def trajectories_of(self, run: RunEntry) -> tuple[Trajectory, ...]:
        """Its own, or the table's, or the experiment as it is."""
        found = self.trajectories if run.trajectories is None else run.trajectories
        return found or (Trajectory(name="a"),)


def _tag_fields(entry: BaseModel) -> list[str]:
    return [name for name in ("rows", "across", "where", "each", "a", "b") if name in type(entry).model_fields]
