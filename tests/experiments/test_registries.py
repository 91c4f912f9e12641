"""Skills, optimisers and controllers of installed packages: found by name, and harmless where they are broken."""

from __future__ import annotations

import pytest

from drivers import registry
from experiments import registries
from experiments.editors import schema_text
from experiments.files import load
from experiments.planning.schema import PlanStage
from experiments.planning.settings import optimiser_model
from experiments.provenance import provenance
from experiments.schema import ExecuteStage
from mechanics.yaml_input import InputError, Refusal
from tests.installed import installer

LAW = """
from pydantic import Field
from control.open_loop import OpenLoop
from control.base import Controller, LawSettings
class Figures(LawSettings):
    gain: float = Field(default=0.5, gt=0)
class Needy(LawSettings):
    gain: float
class Mine(OpenLoop):
    name = "my_law"
    Settings = Figures
class Unnamed(OpenLoop):
    pass
class Unset(OpenLoop):
    name = "unset"
    Settings = Needy
class Strange(OpenLoop):
    name = "strange"
    Settings = dict
class Half(Controller):
    name = "half"
class OurName(OpenLoop):
    name = "closed_loop"
"""
SKILL = """
from planning.skills.grasped_static import GraspedStatic, StaticParameters
class Parameters(StaticParameters):
    lean: float = 1.0
class Lean(GraspedStatic):
    name = "lean"
    Parameters = Parameters
class Odd(GraspedStatic):
    name = "odd"
    Parameters = int
"""
OPTIMISER = """
from dataclasses import dataclass
from typing import ClassVar
from planning.optimisers.gradient import Gradient
@dataclass
class Slow(Gradient):
    name: ClassVar[str] = "slow"
    patience: int = 3
"""


@pytest.fixture
def install(tmp_path):
    def forget():
        optimiser_model.cache_clear()
        for known in (registries.skills(), registries.optimisers(), registries.controllers()):
            known._loaded.clear()

    with installer(tmp_path) as install:
        yield install
    forget()


def wrong(*sets: str) -> list:
    with pytest.raises(InputError) as e:
        load("grasped_static", None, sets)
    return list(e.value.problems)


def controllers(*names: str) -> str:
    return f"stages.1.controllers=[{', '.join(names)}]"


def test_a_controller_its_figures_and_errors_in_them(install):
    install("my-laws", "extrinsic.controllers", LAW, my_law="my_laws:Mine")
    named = controllers("open_loop", "my_law")
    stage = load("grasped_static", None, [named, "stages.1.settings.my_law.gain=0.7"]).experiment.stages[1]
    assert isinstance(stage, ExecuteStage)
    assert stage.law("my_law").gain == 0.7
    [problem] = wrong(named, "stages.1.settings.my_law.gian=0.7")
    assert problem.nearest.endswith("gain")
    assert provenance()["versions"]["my-laws"] == "1.2"


def test_a_skill_and_its_parameters(install):
    install("my-skills", "extrinsic.skills", SKILL, lean="my_skills:Lean")
    stage = load("grasped_static", None, ["stages.0.skill=lean", "stages.0.parameters.lean=2.0"]).experiment.stages[0]
    assert isinstance(stage, PlanStage)
    assert stage.parameters["lean"] == 2.0
    assert (stage.moves_extrinsic, type(stage.skill_parameters).__module__) == (False, "my_skills")


def test_an_optimiser_and_its_settings(install):
    install("my-search", "extrinsic.optimisers", OPTIMISER, slow="my_search:Slow")
    stage = load("grasped_static", None, ["stages.0.optimiser={name: slow, patience: 5}"]).experiment.stages[0]
    assert isinstance(stage, PlanStage)
    assert (stage.optimiser["patience"], type(stage.make_optimiser()).__module__) == (5, "my_search")
    [problem] = wrong("stages.0.optimiser={name: slow, rate: -1.0}")
    assert problem.key == "stages.0.optimiser.rate"


def test_editors_are_told_of_what_is_installed_and_can_be_used(install):
    install("my-laws", "extrinsic.controllers", LAW, my_law="my_laws:Mine", gone="my_laws:Gone")
    install("my-skills", "extrinsic.skills", SKILL, lean="my_skills:Lean", odd="my_skills:Odd")
    text = schema_text("experiment")
    assert '"lean"' in text
    assert '"my_law"' in text
    assert '"odd"' not in text
    assert '"gone"' not in text


@pytest.mark.parametrize(
    ("group", "key"),
    [
        ("skills", "stages.0.skill=mine"),
        ("optimisers", "stages.0.optimiser=mine"),
        ("optimisers", "stages.0.optimiser={name: mine, iterations: 3}"),
        ("controllers", "stages.1.controllers=[open_loop, mine]"),
    ],
)
def test_a_broken_package_harms_nobody_but_who_names_it(install, group, key):
    install("broken-thing", f"extrinsic.{group}", "import nothing_there", mine="broken_thing:Mine")
    load("grasped_static")
    [problem] = wrong(key)
    assert f"{group[:-1]} 'mine' of broken-thing 1.2 (broken_thing:Mine) cannot be imported" in problem.wrong
    assert "ModuleNotFoundError: No module named 'nothing_there'" in problem.wrong
    assert len(wrong(key, "trial.ramp=-1")) == 2  # other errors are told beside it
    assert wrong(key, f"{key.partition('=')[0].rpartition('.')[0]}.nmae=1")


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("half", "Half", "a class under control.base.Controller, with all of its methods"),
        ("figures", "Figures", "a class under control.base.Controller, with all of its methods"),
        ("law", "LAW", None),
        ("mine", "Unnamed", "a class whose `name` is that of its entry point, not 'open_loop'"),
        ("unset", "Unset", "a controller whose `Settings` have a default each"),
        ("strange", "Strange", "a controller whose `Settings` are a control.base.LawSettings"),
    ],
)
def test_what_is_no_controller_is_refused_with_what_it_should_be(install, name, value, expected):
    install("odd-laws", "extrinsic.controllers", LAW, **{name: f"odd_laws:{value}"})
    [problem] = wrong(controllers(name))
    assert f"controller {name!r} of odd-laws 1.2 (odd_laws:{value})" in problem.wrong
    assert expected is None or problem.expected == expected


def test_what_is_no_skill_is_refused_with_what_it_should_be(install):
    install("my-skills", "extrinsic.skills", SKILL, odd="my_skills:Odd")
    [problem] = wrong("stages.0.skill=odd")
    assert problem.expected == "a skill whose `Parameters` are a planning.skills.base.SkillParameters"


def test_ours_come_first(install):
    install("our-laws", "extrinsic.controllers", LAW, closed_loop="our_laws:OurName")
    assert registries.controllers()["closed_loop"].__module__ == "control.closed_loop"
    assert [*registries.controllers()].count("closed_loop") == 1


def test_an_unknown_name_is_answered_with_the_nearest_those_of_packages_among_them(install):
    install("my-laws", "extrinsic.controllers", LAW, my_law="my_laws:Mine")
    [problem] = wrong(controllers("my_lwa"))
    assert problem.nearest == "my_law"
    assert "my_law" in problem.expected
    with pytest.raises(KeyError):
        registries.controllers()["my_lwa"]


@pytest.mark.parametrize("source", ["import nothing_there", "DRIVER = 3"])
def test_a_driver_that_is_none_is_refused_in_the_same_words(install, source):
    install("acme-parts", registry.GROUP, source, acme="acme_parts:DRIVER")
    assert "acme" in registry.names()
    with pytest.raises(Refusal, match=r"driver 'acme' of acme-parts 1.2 \(acme_parts:DRIVER\)"):
        registry.driver("acme")
