"""The way into contact and back, and where a plan is anchored: on the table and, along it, on the extrinsic object."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from control.approach import anchored, resting_eo, retreat
from mechanics import se2
from mechanics.friction import Mode


@pytest.fixture
def pushing(plan):
    """The plan of the go, with an object at its right side: touched at (0.1, 0.04), standing on (0.1, 0)."""
    K, M, N = len(plan.ee), len(plan.preload_go), len(plan.unload_go)
    eo = np.array([0.16, 0.03, 0.0])
    return replace(
        plan,
        eo=np.tile(eo, (K, 1)),
        preload_eo=np.tile(eo, (M, 1)),
        unload_eo=np.tile(eo, (N, 1)),
        contact_names=("object", "ground left"),
        contact_bodies=(("eo", "go"), ("eo", "ground")),
        contact_points=np.tile([[0.1, 0.04], [0.1, 0.0]], (K, 1, 1)),
        contact_normals=np.tile([[1.0, 0.0], [0.0, 1.0]], (K, 1, 1)),
        contact_forces=np.tile([[3.0, 0.0], [5.0, 0.0]], (K, 1, 1)),
        contact_modes=((Mode.STICK, Mode.STICK),) * K,
        contact_mu=np.array([0.3, 0.3]),
    )


def test_a_go_that_stands_leaves_upwards(plan):
    np.testing.assert_allclose(retreat(plan), [0.0, 1.0])


def test_a_go_that_pushes_to_the_right_leaves_to_the_left(pushing):
    np.testing.assert_allclose(retreat(pushing), [-1.0, 0.0])


def test_a_go_that_touches_nothing_leaves_upwards(pushing):
    np.testing.assert_allclose(retreat(replace(pushing, contact_bodies=(("eo", "ground"),) * 2)), [0.0, 1.0])


def test_a_plan_without_an_object_is_anchored_to_the_table_alone(plan):
    table = np.array([0.01, -0.002, 0.01])
    assert resting_eo(plan) is None
    np.testing.assert_array_equal(anchored(plan, table, np.ones(3)).go, plan.reanchored(table).go)


def test_a_plan_stands_where_its_object_does_at_the_tables_height_and_angle(pushing):
    table = np.array([0.01, -0.002, 0.01])
    lies = pushing.preload_eo[0]
    where = se2.compose(table, lies)
    # the object's tag is seen 3 mm further along the table, 1 mm too high and turned by a degree
    seen = se2.compose(table, lies + np.array([0.003, 0.001, np.radians(1.0)]))
    moved = resting_eo(anchored(pushing, table, seen))
    assert moved is not None
    np.testing.assert_allclose(moved[2], where[2], atol=1e-12)
    np.testing.assert_allclose(moved[:2], where[:2] + 0.003 * np.array([np.cos(0.01), np.sin(0.01)]), atol=1e-12)
