"""Where the variables put the go: by hand, and from both bodies' sides."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mechanics.friction import Mode
from mechanics.polygon import Polygon
from planning.closure import eo_jacobian, go_jacobian, go_weight, nominal_start, place, variables
from planning.problem import Body, Form, ObjectContact, Problem, Touch

from .problems import KINDS, clockwise, cross, random_problem, random_z, turn

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


def on_a_step(touch: Touch) -> Problem:
    """A square of side 2 on the environment, which is turned by 90° and lies at (10, 20); travel is 0.5.

    Corner on face: its corner (1, −1) on the line y = 3 of the environment. Face on corner: its lower face, from the
    point (0.25, −1) on, on the environment's point (2, 3).
    """
    corner = touch is Touch.CORNER_ON_FACE
    contact = ObjectContact(
        name="object",
        touch=touch,
        p_go=np.array([1.0, -1.0] if corner else [0.25, -1.0]),
        p_eo=np.array([2.0, 3.0]),
        normal=np.array([0.0, 1.0] if corner else [0.0, -1.0]),
        modes=(Mode.SLIP_NEGATIVE,),
        mu=0.3,
        wish=np.array([[2.0, -0.6]]),
    )
    return Problem(
        skill="by hand",
        form=Form.CLOSED,
        eo=np.array([[10.0, 20.0, np.pi / 2]]),
        eo_body=None,
        go_body=Body(SQUARE, 0.5, np.sqrt(2 / 3)),
        grasp=np.array([0.0, 0.5, 0.1]),
        stiffness=np.eye(3),
        contacts=(contact,),
        ground=(),
        angle=np.array([np.pi / 2]),
        travel=np.array([0.5]),
        free=np.ones((1, 5), bool),
        angle_limits=np.array([[0.0, np.pi]]),
    )


def test_a_corner_goes_to_its_place_on_the_face():
    problem = on_a_step(Touch.CORNER_ON_FACE)
    placed = place(problem, problem.angle, problem.travel)
    # along the face is +x of the environment, which is +y of W: (2.5, 3) lies at (10 − 3, 20 + 2.5);
    # the go is turned by 180°, which puts its corner at (−1, 1) from its centre
    np.testing.assert_allclose(placed.points[0, 0], [7.0, 22.5], atol=1e-15)
    np.testing.assert_allclose(placed.go[0], [8.0, 21.5, np.pi], atol=1e-15)
    np.testing.assert_allclose(placed.normals[0, 0], [-1.0, 0.0], atol=1e-15)
    np.testing.assert_allclose(placed.grasp[0], [8.0, 21.0], atol=1e-15)


def test_a_face_goes_to_its_place_on_the_corner():
    problem = on_a_step(Touch.FACE_ON_CORNER)
    placed = place(problem, problem.angle, problem.travel)
    # along the lower face is −x of the go: its point (−0.25, −1) meets (2, 3), which lies at (7, 22); turned by 180°
    # the point is at (0.25, 1) from the centre, and the lower face looks up, out of the go
    np.testing.assert_allclose(placed.points[0, 0], [7.0, 22.0], atol=1e-15)
    np.testing.assert_allclose(placed.go[0], [6.75, 21.0, np.pi], atol=1e-15)
    np.testing.assert_allclose(placed.normals[0, 0], [0.0, -1.0], atol=1e-15)


def test_what_a_variable_of_one_stands_for():
    closed, paper = (replace(on_a_step(Touch.CORNER_ON_FACE), form=form) for form in Form)
    turned = 1e-3 / np.sqrt(2 / 3)
    for problem, v in ((closed, [1, 1, 1]), (paper, [1e-3, 1e-3, turned])):
        got = variables(problem, np.ones((1, 5)))
        np.testing.assert_allclose([got.angle[0], got.travel[0]], [turned, 1e-3], rtol=1e-15)
        np.testing.assert_allclose(got.v[0], v, rtol=1e-15)


@pytest.mark.parametrize("kind", KINDS[::4], ids=str)
def test_contact_points_of_both_bodies_coincide_whatever_the_variables(kind):
    rng = np.random.default_rng(3)
    problem = random_problem(rng, form=kind[0], two_bodies=kind[1], touch=kind[2], mode=Mode.SLIP_NEGATIVE)
    angle, travel, _ = variables(problem, random_z(problem, rng, spread=20.0))
    placed = place(problem, angle, travel)
    contact = problem.contacts[0]
    for k in range(problem.steps):
        on_face = travel[k] * clockwise(contact.normal)
        corner_on_face = contact.touch is Touch.CORNER_ON_FACE
        p_go = contact.p_go if corner_on_face else contact.p_go + on_face
        p_eo = contact.p_eo + on_face if corner_on_face else contact.p_eo
        of_go = placed.go[k, :2] + turn(placed.go[k, 2]) @ p_go
        of_eo = problem.eo[k, :2] + turn(problem.eo[k, 2]) @ p_eo
        np.testing.assert_allclose(of_go, of_eo, atol=1e-15)
        np.testing.assert_allclose(placed.points[k, 0], of_eo, atol=1e-15)
        assert placed.go[k, 2] - problem.eo[k, 2] == pytest.approx(angle[k], abs=1e-15)


@pytest.mark.parametrize("two_bodies", [True, False])
@pytest.mark.parametrize("touch", Touch)
def test_normals_point_into_the_body_acted_on(touch, two_bodies):
    problem = random_problem(np.random.default_rng(8), two_bodies=two_bodies, touch=touch, contacts=1)
    placed = place(problem, problem.angle, problem.travel)
    # a short way from the contact along the normal is inside the acted-on body, against it inside the other
    acted_on, other = (problem.eo_body, problem.go_body) if two_bodies else (problem.go_body, None)
    poses = (problem.eo, placed.go) if two_bodies else (placed.go, problem.eo)
    for k in range(problem.steps):
        for body, pose, way in ((acted_on, poses[0][k], 1e-4), (other, poses[1][k], -1e-4)):
            if body is None:
                continue
            outline = Polygon(body.vertices).transformed(pose)
            assert outline.signed_distance(placed.points[k, 0] + way * placed.normals[k, 0]) < 0


@pytest.mark.parametrize("two_bodies", [True, False])
@pytest.mark.parametrize("touch", Touch)
def test_travel_that_grows_is_slip_minus_for_every_touch(touch, two_bodies):
    problem = random_problem(np.random.default_rng(5), two_bodies=two_bodies, touch=touch, contacts=1, steps=1)
    before, after = (place(problem, problem.angle, problem.travel + d) for d in (0.0, 1e-6))
    # the go shifts without turning, the other body stands still: so much moves its material along t over it
    along = (after.go[0, :2] - before.go[0, :2]) @ clockwise(before.normals[0, 0])
    seen_by_acted_on = along if two_bodies else -along
    assert seen_by_acted_on == pytest.approx(-1e-6, rel=1e-6)


@pytest.mark.parametrize("two_bodies", [True, False])
def test_jacobians_turn_forces_into_wrenches_about_each_body(two_bodies):
    rng = np.random.default_rng(11)
    problem = random_problem(rng, two_bodies=two_bodies, mode=Mode.STICK, ground=2 if two_bodies else None)
    placed = place(problem, problem.angle, problem.travel)
    forces = rng.normal(size=placed.points.shape)
    on_eo = np.einsum("kcij,kci->kj", eo_jacobian(placed), forces)
    on_go = np.einsum("kcij,kci->kj", go_jacobian(problem, placed), forces)
    for k in range(problem.steps):
        expected_eo, expected_go = np.zeros(3), np.zeros(3)
        for c in range(forces.shape[1]):
            n = placed.normals[k, c]
            f, p = forces[k, c, 0] * n + forces[k, c, 1] * clockwise(n), placed.points[k, c]
            expected_eo += [*f, cross(p - problem.eo[k, :2], f)]
            if c < len(problem.contacts):
                on = -f if two_bodies else f
                expected_go += [*on, cross(p - placed.grasp[k], on)]
        np.testing.assert_allclose(on_eo[k], expected_eo, atol=1e-14)
        np.testing.assert_allclose(on_go[k], expected_go, atol=1e-14)
        arm = placed.go[k, :2] - placed.grasp[k]
        weight = -problem.go_body.mass * problem.gravity
        np.testing.assert_allclose(go_weight(problem, placed)[k], [0.0, weight, arm[0] * weight], atol=1e-15)


def test_the_paper_form_starts_with_the_go_in_balance_under_the_wish():
    problem = random_problem(np.random.default_rng(2), form=Form.PAPER, two_bodies=True, mode=Mode.STICK)
    z = nominal_start(problem)
    np.testing.assert_allclose(z[:, 0] * 1e-3 / problem.go_body.rho, problem.angle, atol=1e-15)
    np.testing.assert_allclose(z[:, 1] * 1e-3, problem.travel, atol=1e-15)
    x = z[:, 2:] * [1e-3, 1e-3, 1e-3 / problem.go_body.rho]
    placed = place(problem, problem.angle, problem.travel)
    for k in range(problem.steps):
        w = problem.stiffness @ x[k]
        push = turn(placed.go[k, 2] + problem.grasp[2]) @ w[:2]
        n, wish = placed.normals[k, 0], problem.contacts[0].wish[k]
        contact = -(wish[0] * n + wish[1] * clockwise(n))
        weight = np.array([0.0, -problem.go_body.mass * problem.gravity])
        np.testing.assert_allclose(push + contact + weight, 0, atol=1e-12)
        about = placed.grasp[k]
        moment = w[2] + cross(placed.points[k, 0] - about, contact) + cross(placed.go[k, :2] - about, weight)
        assert moment == pytest.approx(0, abs=1e-13)


def test_numpy_and_torch_place_alike_and_in_batches():
    rng = np.random.default_rng(7)
    problem = random_problem(rng, two_bodies=True)
    z = np.stack([random_z(problem, rng) for _ in range(3)])
    angle, travel, _ = variables(problem, torch.from_numpy(z))
    batch = place(problem, angle, travel)
    for b in range(3):
        one = place(problem, *variables(problem, z[b])[:2])
        for name in ("go", "points", "normals", "grasp"):
            np.testing.assert_allclose(getattr(batch, name)[b].numpy(), getattr(one, name), atol=1e-15)
