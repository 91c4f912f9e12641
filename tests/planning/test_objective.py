"""The loss of a trajectory: statics written out here, derivatives by central differences, and what it answers where
there is no loss."""

from dataclasses import fields, replace

import numpy as np
import pytest
import torch

from mechanics.friction import Mode
from planning.errors import InfeasiblePlan
from planning.evaluation import OutsideBarrier, backend_of, evaluate
from planning.fused.objective import FusedObjective
from planning.objective import TorchObjective
from planning.problem import Form, Limits, LossWeights, PlanarArm, Touch
from planning.trajectory import pose, program, residuals

from .problems import KINDS, clockwise, cross, pivoting_pentagon, random_problem, random_z, turn

NO_WEIGHTS = LossWeights(*[0.0] * len(fields(LossWeights)))


def problem_of(kind, seed=0, **changes):
    form, two_bodies, touch, mode = kind
    given = {"form": form, "two_bodies": two_bodies, "touch": touch, "mode": mode, "steps": 2} | changes
    return random_problem(np.random.default_rng(seed), **given)


def lacks(mass_and_pose, pushes, couples, gravity):
    """What a body's balance lacks, about W's origin: its weight, forces at points, and couples."""
    mass, pose = mass_and_pose
    total = np.array([0.0, -mass * gravity, sum(couples) - pose[0] * mass * gravity])
    for point, force in pushes:
        total += [*force, cross(point, force)]
    return total


def contact_forces(found, k):
    """(point, force in W) of each contact at step k."""
    return [
        (p, f[0] * n + f[1] * clockwise(n))
        for p, n, f in zip(found.points[k], found.normals[k], found.forces[k], strict=True)
    ]


@pytest.mark.parametrize("backend", ["torch", "fused"])
@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_both_bodies_are_in_balance_and_the_finger_bears_the_rest(kind, backend):
    problem = problem_of(kind, seed=1)
    found = evaluate(problem, random_z(problem, np.random.default_rng(2)), backend)
    assert set(found.solution.status) == {"solved"}
    n, slack = len(problem.contacts), 0.0
    for k in range(problem.steps):
        pushes = contact_forces(found, k)
        if problem.eo_body is not None:
            on_eo = lacks((problem.eo_body.mass, found.eo[k]), pushes, [], problem.gravity)
            np.testing.assert_allclose(on_eo, 0, atol=1e-12)
        sign = -1.0 if problem.eo_body is not None else 1.0
        angle = found.go[k, 2] + problem.grasp[2]
        grasp = found.go[k, :2] + turn(found.go[k, 2]) @ problem.grasp[:2]
        on_go = [(p, sign * f) for p, f in pushes[:n]] + [(grasp, found.wrench[k, :2])]
        s = lacks((problem.go_body.mass, found.go[k]), on_go, [found.wrench[k, 2]], problem.gravity)
        s[2] -= cross(grasp, s[:2])  # about the grasp centre
        if problem.form is Form.CLOSED:
            np.testing.assert_allclose(s, 0, atol=1e-12)
        slack += s @ (s / [1, 1, problem.go_body.rho**2])
        # w = K x, x the pose of ee in the grasp frame
        x = np.array([*(turn(angle).T @ (found.ee[k, :2] - grasp)), found.ee[k, 2] - angle])
        w = problem.stiffness @ x
        np.testing.assert_allclose([*(turn(angle) @ w[:2]), w[2]], found.wrench[k], atol=1e-12)
    if problem.form is Form.PAPER:
        assert found.terms["slack"] == pytest.approx(problem.weights.slack * slack / problem.steps, rel=1e-9)


@pytest.mark.parametrize("backend", ["torch", "fused"])
@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_forces_meet_their_modes(kind, backend):
    problem = problem_of(kind, seed=3)
    found = evaluate(problem, random_z(problem, np.random.default_rng(4)), backend)
    relaxed = problem.eo_body is not None
    assert found.names == tuple(c.name for c in (*problem.contacts, *problem.ground))
    for k in range(problem.steps):
        for c, (mode, mu) in enumerate(zip(found.modes[k], found.mu, strict=True)):
            (f_n, f_t), hard = found.forces[k, c], c >= len(problem.contacts) or not relaxed
            if mode is Mode.FREE:
                assert f_n == f_t == 0
            elif mode.slip_sign:
                assert f_t == pytest.approx(mode.slip_sign * mu * f_n, abs=1e-12)
            elif hard:
                assert abs(f_t) <= mu * f_n + 1e-12
            if hard:
                assert f_n >= -1e-12


def central_gradient(objective, z, h=1e-6):
    """(K, 5) of the free variables, 0 elsewhere; one batch."""
    where = np.argwhere(objective.free)
    batch = np.repeat(z[None], 2 * len(where), axis=0)
    for i, (k, d) in enumerate(where):
        batch[2 * i, k, d] += h
        batch[2 * i + 1, k, d] -= h
    values = objective.values(batch)
    gradient = np.zeros_like(z)
    gradient[tuple(where.T)] = (values[::2] - values[1::2]) / (2 * h)
    return gradient


@pytest.mark.parametrize("limits", [False, True])
@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_the_gradient_is_that_of_central_differences(kind, limits):
    problem = problem_of(kind, seed=5 + limits, limits=limits, contacts=1 if kind[3] is Mode.FREE else None)
    objective = TorchObjective(problem)
    z = random_z(problem, np.random.default_rng(6))
    value, gradient = objective.gradient(z)
    assert value == pytest.approx(objective.values(z[None])[0], rel=1e-12)
    expected = central_gradient(objective, z)
    assert np.abs(expected).max() > 0
    np.testing.assert_allclose(gradient, expected, atol=1e-5 * np.abs(expected).max())


@pytest.mark.parametrize("kind", [KINDS[0], KINDS[6], KINDS[17]], ids=str)
def test_the_gradient_through_cvxpylayers_is_the_same(kind):
    problem = problem_of(kind, seed=5)
    z = random_z(problem, np.random.default_rng(6))
    value, gradient = TorchObjective(problem, "cvxpylayers").gradient(z)
    other_value, other = TorchObjective(problem, "torch").gradient(z)
    assert value == pytest.approx(other_value, rel=1e-6)
    np.testing.assert_allclose(gradient, other, atol=1e-5 * np.abs(other).max())


def stacked_residuals(problem, z):
    """All residuals (B, R) of z (B, K, 5), from the public pieces."""
    with torch.no_grad():
        posed = pose(problem, torch.from_numpy(z))
        forces = backend_of("torch")(program(problem, torch.from_numpy(z))).forces
        parts = residuals(problem, posed, torch.as_tensor(forces).reshape(posed.placed.points.shape))
        return torch.cat([r.reshape(len(z), -1) for r in parts.values()], dim=1).numpy()


@pytest.mark.parametrize("kind", [KINDS[0], KINDS[5], KINDS[9], KINDS[16], KINDS[22], KINDS[25]], ids=str)
def test_the_quadratic_model_is_that_of_differenced_residuals(kind):
    problem = problem_of(kind, seed=7, steps=3, limits=True)
    objective, h = TorchObjective(problem), 1e-6
    z = random_z(problem, np.random.default_rng(8))
    model = objective.quadratic(z)
    steps = h * np.eye(15).reshape(15, 3, 5) * problem.free
    J = (stacked_residuals(problem, z + steps) - stacked_residuals(problem, z - steps)).T.reshape(-1, 3, 5) / (2 * h)
    H = 2 * np.einsum("rki,rlj->kilj", J, J)
    size = np.abs(H).max()
    value, gradient = objective.gradient(z)
    assert model.value == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose(model.gradient, gradient, atol=1e-12 * np.abs(gradient).max())
    for k in range(3):
        np.testing.assert_allclose(model.diagonal[k], H[k, :, k], atol=1e-6 * size)
    for k in range(2):
        np.testing.assert_allclose(model.below[k], H[k + 1, :, k], atol=1e-6 * size)
    np.testing.assert_allclose(H[2, :, 0], 0, atol=1e-9 * size)  # nothing couples steps farther apart


def test_the_terms_are_the_losses_and_their_sum_is_the_value():
    problem = replace(pivoting_pentagon(steps=4), weights=LossWeights(cone=2.0, force=3.0, smooth=0.5, track=0.0))
    z = random_z(problem, np.random.default_rng(0))
    found = evaluate(problem, z)
    assert set(found.terms) == {"cone", "pull", "force", "penetration", "smooth"}
    assert found.value == pytest.approx(sum(found.terms.values()), rel=1e-15)
    f = found.forces[:, 0]
    cosine = f[:, 0] / np.hypot(*f.T)
    assert found.terms["cone"] == pytest.approx(2 * np.mean((1 - cosine) ** 2), rel=1e-9)
    missed = ((f - problem.contacts[0].wish) ** 2).sum(axis=1)
    assert found.terms["force"] == pytest.approx(3 * np.mean(missed), rel=1e-12)
    step = np.diff(found.go, axis=0) * [1e3, 1e3, 1e3 * problem.go_body.rho]
    assert found.terms["smooth"] == pytest.approx(0.5 * np.mean((step**2).sum(axis=1)), rel=1e-12)
    lo, hi = problem.angle_limits.T
    angle = z[:, 0] * problem.scale[0]
    barrier = (np.log(angle - lo) / 10) ** 2 + (np.log(hi - angle) / 10) ** 2
    assert found.terms["penetration"] == pytest.approx(problem.weights.penetration * np.mean(barrier), rel=1e-12)


def test_the_pivoting_pentagon_needs_what_the_study_says():
    found = evaluate(replace(pivoting_pentagon(), force_weight=1e6), pivoting_pentagon().start)
    ratio = np.abs(found.forces[..., 1]) / found.forces[..., 0]
    np.testing.assert_allclose(ratio.max(axis=0), [0.21, 0.37], atol=0.01)
    np.testing.assert_allclose(found.forces[:, 0, 0], 3.0, atol=1e-3)


def test_two_contacts_share_what_is_asked_for_and_one_alone_carries_it():
    lying = random_problem(
        np.random.default_rng(3), form=Form.CLOSED, two_bodies=False, contacts=2, mode=Mode.STICK, steps=2
    )
    first, second = lying.contacts
    assert first.wish[1, 0] > 0
    wish = np.array(second.wish)
    wish[1] = 0
    problem = replace(lying, contacts=(first, replace(second, modes=(Mode.STICK, Mode.FREE), wish=wish)))
    z = problem.start + 0
    z[:, 2:4] = [2.0, 0.1]
    np.testing.assert_allclose(program(problem, z).desired, [[[1.0, 0.05]] * 2, [[2.0, 0.1], [0.0, 0.0]]])
    found = evaluate(problem, z)
    np.testing.assert_allclose(found.forces.sum(axis=1), [[2.0, 0.1]] * 2, atol=1e-12)
    assert set(found.terms) >= {"force"}
    assert "cone" not in found.terms  # the program itself keeps the cones of P2


def test_what_is_not_free_stays_as_it_is_and_has_no_gradient():
    problem = pivoting_pentagon(steps=3)
    free = np.array(problem.free)
    free[1] = False
    objective = TorchObjective(replace(problem, free=free))
    z = random_z(problem, np.random.default_rng(0))
    other = np.where(free, z, np.nan)
    value, gradient = objective.gradient(z)
    assert objective.gradient(other)[0] == value
    assert objective.values(other[None])[0] == pytest.approx(value, rel=1e-14)
    assert (gradient[~free] == 0).all()
    model = objective.quadratic(other)
    assert (model.diagonal[1] == 0).all()
    assert (model.below == 0).all()
    assert (objective.evaluate(other).go[1] == objective.evaluate(problem.start).go[1]).all()


def test_a_batch_has_the_values_of_its_members():
    rng = np.random.default_rng(1)
    for kind in (KINDS[0], KINDS[12], KINDS[20]):
        problem = problem_of(kind, seed=2, steps=3)
        objective = TorchObjective(problem)
        z = np.stack([random_z(problem, rng) for _ in range(4)])
        alone = [objective.evaluate(one).value for one in z]
        np.testing.assert_allclose(objective.values(z), alone, rtol=1e-12)
    assert objective.values(z[:0]).shape == (0,)


def sliding_block():
    """An eo on a vertex that sticks, pushed by a contact that slips: three forces, fixed by the three balances."""
    for seed in range(50):
        problem = random_problem(
            np.random.default_rng(seed),
            form=Form.CLOSED,
            two_bodies=True,
            touch=Touch.FACE_ON_CORNER,
            mode=Mode.SLIP_POSITIVE,
            ground=1,
            steps=3,
            limits=False,
        )
        if problem.ground[0].modes[0] is Mode.STICK:
            return problem
    raise AssertionError("no such problem")


def ground_force(problem, z):
    """(f_n, f_t) of the ground at each step, by solving the eo's three balances."""
    found = program(problem, z)
    J = found.eo_jacobian
    assert J is not None
    assert found.eo_load is not None
    slope = problem.contacts[0].mu  # f_t = +µ f_n
    columns = np.stack([J[:, 0, 0] + slope * J[:, 0, 1], J[:, 1, 0], J[:, 1, 1]], axis=2)
    return np.linalg.solve(columns, -found.eo_load[..., None])[:, 1:, 0]


@pytest.mark.parametrize("loss", [TorchObjective, FusedObjective])
def test_an_infeasible_step_makes_one_member_of_a_batch_infinite_and_is_named(loss):
    problem = replace(sliding_block(), weights=LossWeights(penetration=0.0))
    objective, z = loss(problem), problem.start
    turned = np.repeat(z[None], 121, axis=0)  # the face at step 1, until the ground cannot hold the eo
    turned[:, 1, 0] += np.linspace(-60, 60, 121)
    f_n, f_t = ground_force(problem, turned).reshape(121, 3, 2)[:, 1].T
    bad = turned[np.flatnonzero(np.abs(f_t) > problem.ground[0].mu * f_n + 0.01)[0]]
    values = objective.values(np.stack([z, bad, z]))
    assert np.isfinite(values).tolist() == [True, False, True]
    assert values[1] == np.inf
    value, gradient = objective.gradient(bad)
    assert (value, gradient.any()) == (np.inf, False)
    assert objective.quadratic(bad).value == np.inf
    found = objective.evaluate(bad)
    assert found.value == np.inf
    assert [status == "solved" for status in found.solution.status] == [True, False, True]
    refusal = objective.refusal(bad)
    assert isinstance(refusal, InfeasiblePlan)
    assert refusal.step == 1
    assert objective.refusal(z) is None


def far_arm(problem):
    return PlanarArm(np.array([5.0, 5.0]), 0.5, 0.4, np.zeros(2), 1, np.zeros(3), np.array([[-3.0, 3.0]] * 3))


def beyond(problem):
    ee = evaluate(problem, problem.start).ee
    return np.stack([ee.min(axis=0) - 1, ee.max(axis=0) + np.array([1, -1e-4, 1])], axis=1)


BARRIERS = {
    "workspace": (lambda p: Limits(workspace=beyond(p)), r"workspace, step \d+: the end-effector's y is .* mm"),
    "joints": (lambda p: Limits(arm=far_arm(p)), r"joints, step 0: the arm does not reach \(.*\) mm"),
    "sensor force": (lambda p: Limits(force=0.5), r"sensor, step 0: the sensor takes 0.5 N and is to carry \d"),
    "sensor torque": (lambda p: Limits(torque=1e-4), r"sensor, step \d: the sensor takes 0.1 N·mm and is to carry \d"),
}


@pytest.mark.parametrize("loss", [TorchObjective, FusedObjective])
@pytest.mark.parametrize("name", BARRIERS)
def test_outside_a_barrier_the_loss_is_infinite_and_the_refusal_has_the_figure(name, loss):
    limits, message = BARRIERS[name]
    problem = pivoting_pentagon(steps=3)
    objective = loss(replace(problem, limits=limits(problem)))
    z = objective.start
    assert objective.values(z[None]) == [np.inf]
    assert objective.gradient(z)[0] == objective.quadratic(z).value == objective.evaluate(z).value == np.inf
    refusal = objective.refusal(z)
    assert isinstance(refusal, OutsideBarrier)
    with pytest.raises(InfeasiblePlan, match=message):
        raise refusal


@pytest.mark.parametrize("loss", [TorchObjective, FusedObjective])
def test_penetration_is_refused_with_the_angle_and_its_limits(loss):
    problem = pivoting_pentagon(steps=3)
    objective, z = loss(problem), problem.start + 0
    z[2, 0] = np.radians(37) / problem.scale[0]
    assert objective.values(np.stack([z, problem.start]))[0] == np.inf
    refusal = objective.refusal(z)
    assert str(refusal) == "penetration, step 2: the relative angle is 37°, admissible are -54° to 36°"


def test_limits_that_are_wide_leave_the_loss_finite():
    problem = random_problem(np.random.default_rng(3), two_bodies=True, mode=Mode.STICK, limits=True)
    found = evaluate(problem, problem.start)
    assert {"workspace", "joints", "sensor"} <= set(found.terms)
    assert np.isfinite(found.value)


def test_infinite_values_never_become_nan():
    problem = random_problem(np.random.default_rng(3), two_bodies=True, mode=Mode.STICK, limits=True, steps=2)
    objective, z = TorchObjective(problem), problem.start
    batch = np.stack([z, np.full_like(z, np.nan), z + 1e5, z - 1e5, np.full_like(z, np.inf)])
    values = objective.values(batch)
    assert np.isfinite(values[0])
    assert (values[1:] == np.inf).all()


@pytest.mark.parametrize("loss", [TorchObjective, FusedObjective])
def test_a_wrong_z_is_refused(loss):
    problem = pivoting_pentagon(steps=3)
    objective, z = loss(problem), problem.start
    with pytest.raises(ValueError, match=r"z: expected shape \(3, 5\), received \(2, 5\)"):
        objective.gradient(z[:2])
    with pytest.raises(ValueError, match=r"z: expected shape \(B, 3, 5\), received \(3, 5\)"):
        objective.values(z)
    bad = z + 0
    bad[1, 2] = np.nan
    for ask in (objective.quadratic, objective.refusal):
        with pytest.raises(ValueError, match="z: step 1: expected finite numbers"):
            ask(bad)


def test_an_unknown_backend_is_refused():
    with pytest.raises(ValueError, match=r"backend: expected one of .*torch.*, received 'osqp'"):
        TorchObjective(pivoting_pentagon(steps=3), "osqp")


def test_without_any_loss_the_value_is_zero():
    objective = TorchObjective(replace(pivoting_pentagon(steps=3), weights=NO_WEIGHTS))
    assert objective.gradient(objective.start)[0] == 0
    assert (objective.values(objective.start[None]) == 0).all()


@pytest.mark.parametrize("kind", [KINDS[0], KINDS[9], KINDS[22]], ids=str)
def test_the_residuals_in_numpy_and_in_torch_are_the_same(kind):
    problem = problem_of(kind, seed=4, steps=3, limits=True)
    z = random_z(problem, np.random.default_rng(1))
    forces = evaluate(problem, z).forces
    plain = residuals(problem, pose(problem, z), forces)
    tensors = residuals(problem, pose(problem, torch.from_numpy(z)), torch.from_numpy(forces))
    assert list(plain) == list(tensors)
    for name, residual in plain.items():
        assert isinstance(residual, np.ndarray)
        np.testing.assert_allclose(tensors[name], residual, rtol=1e-12, atol=1e-14, err_msg=name)


def test_the_program_in_numpy_and_in_torch_is_the_same():
    problem = random_problem(np.random.default_rng(0), form=Form.PAPER, two_bodies=True, steps=3)
    z = random_z(problem, np.random.default_rng(1))
    plain, batch = program(problem, z), program(problem, torch.from_numpy(np.stack([z, z])))
    assert isinstance(plain.desired, np.ndarray)
    for item in fields(plain):
        a, b = getattr(plain, item.name), getattr(batch, item.name)
        if isinstance(b, torch.Tensor):
            whole = b.numpy()[: len(a)]
            np.testing.assert_allclose(whole, a, atol=1e-15)
    assert batch.steps == 6
    weights = [problem.slack_weight, problem.slack_weight, problem.slack_weight / problem.go_body.rho**2]
    np.testing.assert_allclose(np.asarray(plain.slack_weights), weights)
    assert (plain.weights == 1).all()
    assert (plain.desired == 0).all()
    closed = program(replace(problem, form=Form.CLOSED, free=problem.free), z)
    assert (closed.weights[:, 0] == problem.force_weight).all()
    assert (closed.weights[:, 1:] == 1).all()
    assert closed.go_jacobian is None
