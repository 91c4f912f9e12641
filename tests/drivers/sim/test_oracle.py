"""The yardstick itself: Lemke against enumeration, the complementarity time stepping against pencil and paper."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from drivers.scene import Body

from .oracle.cases import PIVOTS, pivot_task
from .oracle.lemke import RayTermination, lemke
from .oracle.quasistatic import Oracle
from .oracle.statics import Held, turn

WEIGHT = 0.5 * 9.81
HBOX = Body(name="hbox", vertices=((-0.06, -0.03), (0.06, -0.03), (0.06, 0.03), (-0.06, 0.03)), mass=0.5)


def residual(M, q, z) -> float:
    """How far z is from a solution: negative parts and products."""
    w = M @ z + q
    return max(-z.min(), -w.min(), np.abs(z * w).max())


def solutions(M, q) -> list[np.ndarray]:
    """Every basic solution, by trying which of w and z is zero in each pair."""
    n, found = len(q), []
    for basic in product([False, True], repeat=n):
        at = np.flatnonzero(basic)
        z = np.zeros(n)
        if np.linalg.matrix_rank(M[np.ix_(at, at)]) < at.size:
            continue
        z[at] = np.linalg.solve(M[np.ix_(at, at)], -q[at])
        if residual(M, q, z) < 1e-9:
            found.append(z)
    return found


# -- Lemke ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [1, 3, 6, 12, 24])
def test_positive_definite_problem_is_solved(n):
    draw = np.random.default_rng(n)
    for _ in range(50):
        root = draw.normal(size=(n, n))
        # positive definite, and not symmetric, like a Jacobian with a follower load
        M = root @ root.T + 0.1 * np.eye(n) + (lower := np.tril(draw.normal(size=(n, n)))) - lower.T
        q = draw.normal(size=n)
        assert residual(M, q, lemke(M, q)) < 1e-9


@pytest.mark.parametrize("n", [1, 2, 4, 6])
def test_unique_solution_is_the_one_that_enumeration_finds(n):
    draw = np.random.default_rng(100 + n)
    for _ in range(20):
        root = draw.normal(size=(n, n))
        M, q = root @ root.T + 0.1 * np.eye(n), draw.normal(size=n)
        (only,) = solutions(M, q)
        np.testing.assert_allclose(lemke(M, q), only, atol=1e-9)


def test_friction_problem_is_solved_among_those_of_enumeration():
    """The structure that contact problems have: copositive, with a cone row; n = 4 for one contact."""
    draw = np.random.default_rng(7)
    for _ in range(100):
        root = draw.normal(size=(2, 2))
        A = root @ root.T + 0.05 * np.eye(2)
        J = np.array([[1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        M = np.zeros((4, 4))
        M[:3, :3] = J @ A @ J.T
        M[1:3, 3], M[3] = 1.0, [0.4, -1.0, -1.0, 0.0]
        q = np.append(J @ draw.normal(size=2), 0.0)
        z = lemke(M, q)
        assert residual(M, q, z) < 1e-9
        forces = [(s[0], s[1] - s[2]) for s in solutions(M, q)]
        assert min(np.hypot(f[0] - z[0], f[1] - (z[1] - z[2])) for f in forces) < 1e-8


def test_degenerate_problem_does_not_cycle():
    """Many rows alike and zeros on the right: where the least index rule of the textbooks cycles."""
    draw = np.random.default_rng(3)
    for _ in range(50):
        root = draw.integers(-1, 2, size=(12, 5)).astype(float)
        M = root @ root.T
        # q in the range of M keeps the semidefinite problem solvable
        q = np.where(draw.random(12) < 0.5, 0.0, 1.0) - M @ draw.integers(0, 2, size=12)
        assert residual(M, q, lemke(M, q)) < 1e-8


def test_problem_without_solution_is_told():
    with pytest.raises(RayTermination):
        lemke(np.array([[-1.0]]), np.array([-1.0]))


# -- the time stepping ---------------------------------------------------------------------------------------------


def test_oracle_hangs_the_go_where_fingers_carry_its_weight(make_scene):
    scene = make_scene(start=(0.1, 0.3, 0.4))
    oracle = Oracle(scene)
    held = Held(0.1, np.array([-0.025, -0.07345]), np.array([0.0, 0.045]), np.array(scene.stiffness))
    x, y, angle = oracle.go
    corner = np.array([x, y]) + turn(angle) @ held.corner
    np.testing.assert_allclose(held.ee(angle, corner, np.zeros(2)), [0.1, 0.3, 0.4], atol=1e-10)
    np.testing.assert_allclose(oracle.wrench[:2], [0.0, 0.981], atol=1e-9)


@pytest.mark.parametrize("push", [(0.0, 4.0), (1.3, 4.0), (-1.3, 4.0)])
def test_oracle_holds_a_corner_inside_the_cone_where_statics_has_it(make_scene, push):
    scene = make_scene(start=(0.0, 0.2, 0.3))
    held = Held(0.1, np.array([-0.025, -0.07345]), np.array([0.0, 0.045]), np.array(scene.stiffness))
    oracle = Oracle(scene)
    oracle.move(held.ee(0.3, np.zeros(2), np.zeros(2)), 4)
    oracle.move(held.ee(0.3, np.zeros(2), np.array(push)))
    np.testing.assert_allclose(oracle.go, held.go(0.3, np.zeros(2)), atol=1e-9)
    np.testing.assert_allclose(oracle.wrench, held.wrench(0.3, np.array(push)), atol=1e-6)
    touch = oracle.touch("go", "ground")
    np.testing.assert_allclose(touch.force, push, atol=1e-6)
    np.testing.assert_allclose(touch.normal, [0.0, 1.0])
    assert abs(touch.slip) < 1e-9


@pytest.mark.parametrize("direction", [-1, 1])
def test_oracle_slides_a_corner_at_the_cone(make_scene, direction):
    """Far along, the corner follows the end-effector: what lies between is K⁻¹ of a force on the cone."""
    scene = make_scene(start=(0.0, 0.2, 0.3))
    held = Held(0.1, np.array([-0.025, -0.07345]), np.array([0.0, 0.045]), np.array(scene.stiffness))
    oracle = Oracle(scene)
    oracle.move(held.ee(0.3, np.zeros(2), np.zeros(2)), 4)
    oracle.move(held.ee(0.3, np.zeros(2), np.array([0.0, 4.0])))
    slid = held.ee(0.3, np.array([direction * 0.02, 0.0]), np.array([-direction * 0.33 * 4.0, 4.0]))
    oracle.move(slid, 10)
    np.testing.assert_allclose(oracle.go, held.go(0.3, np.array([direction * 0.02, 0.0])), atol=1e-9)
    assert oracle.touch("go", "ground").slip == pytest.approx(direction * 0.02, abs=1e-9)


def test_oracle_shares_a_block_between_its_two_corners_by_the_lever(make_scene):
    """Two-point support: a vertical push of 2 N at x = 20 mm on a block of half-width 60 mm."""
    corner = np.array([-0.025, -0.07345])
    scene = make_scene(extrinsic=HBOX, extrinsic_pose=(0.0, 0.03, 0.0), start=(0.0, 0.3, 0.3))
    held = Held(0.1, corner, np.array([0.0, 0.045]), np.array(scene.stiffness))
    oracle = Oracle(scene)
    at = np.array([0.02, 0.06])
    oracle.move(held.ee(0.3, at, np.zeros(2)), 4)
    oracle.move(held.ee(0.3, at, np.array([0.0, 2.0])))
    np.testing.assert_allclose(oracle.eo, [0.0, 0.03, 0.0], atol=1e-9)
    carried = {round(t.point[0] * 1e3): t.force[1] for t in oracle.touches if t.body == "eo"}
    assert carried == {-60: pytest.approx(WEIGHT / 2 + 2 * 40 / 120), 60: pytest.approx(WEIGHT / 2 + 2 * 80 / 120)}


def test_oracle_pushes_a_block_at_mu_times_its_weight(make_scene):
    """The go's side face on the block's corner: face on corner, and the ground slips."""
    scene = make_scene(
        extrinsic=HBOX,
        extrinsic_pose=(0.2, 0.03, 0.0),
        start=(0.085, 0.13, -0.05),
        friction={"go-ground": 0.33, "go-eo": 0.33, "eo-ground": 0.2},
    )
    oracle = Oracle(scene)
    oracle.move((0.14, 0.13, -0.05), 20)
    x, y, angle = oracle.eo
    assert 0.215 < x < 0.235
    np.testing.assert_allclose([y, angle], [0.03, 0.0], atol=1e-9)
    ground = np.sum([t.force for t in oracle.touches if (t.body, t.other) == ("eo", "ground")], axis=0)
    assert -ground[0] / ground[1] == pytest.approx(0.2)
    # what the fingers push and the go's weight is all that the ground holds back
    assert oracle.wrench[0] == pytest.approx(-ground[0], abs=1e-6)
    assert oracle.wrench[1] == pytest.approx(0.981 + WEIGHT - ground[1], abs=1e-6)
    touch = oracle.touch("eo", "go")
    np.testing.assert_allclose(touch.force + ground, [0.0, WEIGHT], atol=1e-6)
    along = touch.force @ [touch.normal[1], -touch.normal[0]]
    assert abs(along) <= (0.33 + 1e-9) * (touch.force @ touch.normal)


@pytest.mark.parametrize("name", PIVOTS)
def test_oracle_tips_an_object_at_the_push_that_balances_it_about_its_corner(name):
    task = pivot_task(name)
    oracle = Oracle(task.scene())
    oracle.move(task.ee(0.0, 0.0), 4)
    oracle.move(task.ee(0.0, 0.999))
    np.testing.assert_allclose(oracle.eo, task.pivot.eo(0.0), atol=1e-9)
    carried = [t.force[1] for t in oracle.touches if (t.body, t.other) == ("eo", "ground")]
    assert len(carried) == 2 and min(carried) < 0.01 < max(carried)
    oracle.move(task.ee(0.0, 1.001))
    assert oracle.touch("eo", "ground").point == pytest.approx([0.0, 0.0], abs=1e-9)
    assert oracle.eo[2] < -1e-7


@pytest.mark.parametrize("name", PIVOTS)
def test_oracle_turns_an_object_as_statics_has_it(name):
    task = pivot_task(name)
    oracle = Oracle(task.scene())
    oracle.move(task.ee(0.0, 0.0), 4)
    oracle.move(task.ee(0.0))
    for angle in -np.radians([5, 10, 15, 20, 25]):
        oracle.move(task.ee(angle), 4)
        np.testing.assert_allclose(oracle.eo, task.pivot.eo(angle), atol=1e-8)
        np.testing.assert_allclose(oracle.go, task.go(angle), atol=1e-8)
        np.testing.assert_allclose(oracle.wrench, task.wrench(angle), atol=1e-4)
