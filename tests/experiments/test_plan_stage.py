"""The plan stage of an experiment file: what may stand there, what is filled in, and what is refused."""

from __future__ import annotations

from dataclasses import asdict

import numpy as np
import pytest

from experiments.planning.schema import PlanStage
from mechanics.yaml_input import InputError, parse, read_text
from planning.optimisers.base import OPTIMISERS
from planning.problem import Form, LossWeights

STAGE = "stage: plan\nname: press\nskill: grasped_static\n"


def stage(*lines: str, **sets: str) -> PlanStage:
    return parse(PlanStage, read_text(STAGE + "\n".join(lines), "x.yaml"), {k: str(v) for k, v in sets.items()})


def refused(*lines: str):
    with pytest.raises(InputError) as e:
        stage(*lines)
    assert len(e.value.problems) == 1, str(e.value)
    return e.value.problems[0]


def test_what_is_not_said_is_second_order_fused_and_in_closed_form():
    plain = stage()
    assert plain.optimiser["name"] == "lm"
    assert (plain.backend, plain.form) == ("fused", "closed")
    assert plain.planner_form() is Form.CLOSED
    assert plain.loss_weights() == LossWeights()
    assert plain.start.sigma == 0


@pytest.mark.parametrize("name", ["gradient", "lm", "mppi", "icem"])
def test_every_optimiser_stands_with_all_its_figures(name):
    named = stage(f"optimiser: {name}")
    made = named.make_optimiser()
    assert isinstance(made, OPTIMISERS[name])
    written = {key: value for key, value in named.optimiser.items() if key != "name"}
    assert len(written) >= 2
    for key, value in written.items():
        own = getattr(made, key)
        assert value == (list(own) if isinstance(own, tuple) else own)
    assert stage(f"optimiser: {{name: {name}}}") == named


def test_settings_of_an_optimiser_reach_it():
    def figures(made) -> tuple[int, int | None]:
        return made.iterations, getattr(made, "samples", None)

    assert figures(stage("optimiser: {name: icem, iterations: 10, samples: 10}").make_optimiser()) == (10, 10)
    assert figures(stage("optimiser: {iterations: 7}").make_optimiser()) == (7, None)
    assert figures(stage(**{"optimiser.iterations": "8"}).make_optimiser()) == (8, None)


def test_weights_reach_the_losses():
    weights = stage("weights: {cone: 2, force: 0}").loss_weights()
    assert (weights.cone, weights.force) == (2.0, 0.0)
    assert asdict(weights) == {**asdict(LossWeights()), "cone": 2.0, "force": 0.0}


def test_limits_reach_the_planner_in_si():
    limits = stage(
        "limits: {workspace: {x: [-0.2, 0.3], angle_deg: [-45, 90]}, force: 15, torque: 0.5}"
    ).limits.limits()
    assert limits.workspace is not None
    np.testing.assert_allclose(limits.workspace[[0, 2]], [[-0.2, 0.3], [-np.pi / 4, np.pi / 2]])
    assert (limits.force, limits.torque, limits.arm) == (15.0, 0.5, None)


def test_an_arm_reaches_the_planner_in_si():
    arm = stage(
        "limits:",
        "  arm: {base: [-0.5, 0.3], upper: 0.4, fore: 0.35, limits_deg: [[-90, 90], [0, 150], [-120, 120]]}",
    ).limits.limits()
    assert arm.arm is not None
    np.testing.assert_allclose(arm.arm.limits, np.radians([[-90, 90], [0, 150], [-120, 120]]))
    np.testing.assert_allclose(arm.arm.base, [-0.5, 0.3])
    assert (arm.arm.upper, arm.arm.fore, arm.arm.elbow) == (0.4, 0.35, 1)


CASES = {
    "unknown optimiser": ("optimiser: gradiant", "optimiser", "unknown optimiser 'gradiant'", "gradient"),
    "unknown name of an optimiser": ("optimiser: {name: lmm}", "optimiser.name", "unknown optimiser 'lmm'", "lm"),
    "misspelt setting": ("optimiser: {name: mppi, sampels: 9}", "optimiser.sampels", "unknown key", "samples"),
    "setting of another optimiser": ("optimiser: {name: lm, samples: 9}", "optimiser.samples", "unknown key", ""),
    "setting of a wrong type": ("optimiser: {iterations: many}", "optimiser.iterations", "text 'many'", ""),
    "setting out of range": ("optimiser: {name: gradient, rate: -1}", "optimiser.rate", "expected a positive", ""),
    "optimiser that is a list": ("optimiser: [lm]", "optimiser", "a list of 1", ""),
    "unknown backend": ("backend: fussed", "backend", "unknown value 'fussed'", "fused"),
    "unknown form": ("form: open", "form", "unknown value 'open'", ""),
    "negative weight": ("weights: {cone: -1}", "weights.cone", "the number -1", ""),
    "misspelt weight": ("weights: {cne: 1}", "weights.cne", "unknown key", "cone"),
    "workspace inside out": ("limits: {workspace: {x: [1, 0]}}", "limits.workspace.x", "is no range", ""),
    "force limit of nothing": ("limits: {force: 0}", "limits.force", "the number 0", ""),
    "negative start": ("start: {sigma: -0.5}", "start.sigma", "the number -0.5", ""),
    "misspelt key of the start": ("start: {sigam: 0.5}", "start.sigam", "unknown key", "sigma"),
    "start that is no mapping": ("start: 0.5", "start", "the number 0.5", ""),
    "half an arm": ("limits: {arm: {upper: 1}}", None, "missing key", ""),
}


@pytest.mark.parametrize("case", list(CASES))
def test_what_does_not_fit_is_refused_where_it_stands(case):
    line, key, wrong, near = CASES[case]
    if key is None:
        with pytest.raises(InputError) as e:
            stage(line)
        assert {problem.key for problem in e.value.problems} >= {"limits.arm.base", "limits.arm.limits_deg"}
        return
    found = refused(line)
    assert (found.file, found.line, found.key) == ("x.yaml", 4, key)
    assert wrong in found.wrong
    if near:
        assert found.nearest == near
