"""What is missing where forces do not balance, by closed forms of statics."""

# pyright: reportOptionalMemberAccess=false, reportOptionalSubscript=false, reportOptionalOperand=false
# pyright: reportOperatorIssue=false, reportArgumentType=false, reportCallIssue=false

from dataclasses import replace

import numpy as np
import pytest

from mechanics.catalogue import load_object
from mechanics.contact import jacobian
from planning import feasibility
from planning.errors import InfeasiblePlan
from planning.program import FREE, SLIP_MINUS, SLIP_PLUS, STICK, ContactProgram

WEIGHT = 0.15 * 9.81


def standing(feet, contact, normal, modes, mu=(0.33, 0.33), wish=(3.0, 0.0), steps=1, weight=WEIGHT):
    """A body about its centre of mass on ``feet``, pushed at ``contact`` along ``normal``; µ of ground and object."""
    C = len(feet) + 1
    normals = np.array([[0.0, 1.0]] * len(feet) + [normal])
    J = jacobian(normals, np.array([*feet, contact]))
    sides = ("ground left", "ground right")
    return ContactProgram(
        names=(*(sides if len(feet) == 2 else ("ground right",)), "object"),
        modes=np.tile(modes, (steps, 1)),
        desired=np.tile([[0.0, 0.0]] * len(feet) + [list(wish)], (steps, 1, 1)),
        mu=np.tile([mu[0]] * len(feet) + [mu[1]], (steps, 1)),
        weights=np.ones((steps, C, 2)),
        relaxed=(False,) * len(feet) + (True,),
        eo_jacobian=np.tile(J, (steps, 1, 1, 1)),
        eo_load=np.tile([0.0, -weight, 0.0], (steps, 1)),
    )


def pivot(name="pentagon", contact=(-0.0065, 0.063), mu=(0.33, 0.33), **changes):
    """A shape on its flat side about to turn about its right foot, pushed from above at a point of its outline."""
    outline = load_object(name).polygon
    foot = max(outline.vertices[list(outline.lowest_vertices())].tolist())
    corners = outline.vertices
    face = int(np.argmin(np.abs(((np.array(contact) - corners) * outline.normals).sum(1))))
    return standing([foot], contact, -outline.normals[face], (STICK, STICK), mu, **changes), np.array(foot)


def least_ground_friction(program, foot, contact, mu_object):
    """Three forces meet in a point: the push from its cone, the weight, and the ground's reaction at the foot."""
    n = program.eo_jacobian[0, 1, 0, :2]
    t = np.array([n[1], -n[0]])
    least = np.inf
    for side in np.linspace(-mu_object, mu_object, 20001):
        along = n + side * t
        height = contact[1] - foot[1] + (0.0 - contact[0]) / along[0] * along[1]  # where the push crosses x = 0
        reaction = np.array([0.0 - foot[0], height])
        if height > 0 and along[1] < 0:
            least = min(least, abs(reaction[0]) / reaction[1])
    return least


@pytest.mark.parametrize(
    ("name", "contact"),
    [("pentagon", (-0.0065, 0.063)), ("triangle", (-0.0075, 0.0603)), ("heptagon", (-0.007, 0.0675))],
)
def test_the_least_friction_of_a_pivot_is_where_three_forces_meet(name, contact):
    program, foot = pivot(name, contact, mu=(0.01, 0.33))
    found = feasibility.explain(program, 0)
    assert found is not None
    assert (found.step, found.contact, found.has, found.reason) == (0, "ground right", 0.01, None)
    np.testing.assert_allclose(found.needs, least_ground_friction(program, foot, contact, 0.33), rtol=1e-3)


def test_with_a_little_less_friction_than_it_needs_a_step_is_infeasible_and_with_a_little_more_it_is_not():
    needs = feasibility.explain(pivot()[0], 0).needs
    assert feasibility.explain(pivot(mu=(1.001 * needs, 0.33))[0], 0) is None
    assert feasibility.explain(pivot(mu=(0.999 * needs, 0.33))[0], 0) is not None


def test_a_wish_that_is_held_needs_more_than_a_force_that_may_be_chosen():
    """tasks: the pentagon from flat needs µ = 0.35 with the best force, 0.37 at f_n = 3 N."""
    program, _ = pivot()
    np.testing.assert_allclose(feasibility.explain(program, 0).needs, 0.35, atol=0.005)
    held = np.array([[False, False], [True, False]])
    np.testing.assert_allclose(feasibility.explain(program, 0, held=held).needs, 0.37, atol=0.005)


def test_the_first_infeasible_step_is_refused_in_words_that_name_contact_and_figures():
    program, _ = pivot(mu=(0.5, 0.33), steps=20)
    mu = program.mu.copy()
    mu[12:, 0] = 0.33
    with pytest.raises(InfeasiblePlan, match=r"^ground right, step 12: needs µ ≥ 0\.353, has 0\.33") as caught:
        feasibility.check(replace(program, mu=mu))
    assert (caught.value.step, caught.value.contact, caught.value.have) == (12, "ground right", 0.33)
    feasibility.check(program)


def test_a_relaxed_contact_may_stay_relaxed():
    """The object may pull the pentagon over: then its cone is the optimiser's affair, and the ground's is not."""
    program, _ = pivot(contact=(-0.0065, 0.063), mu=(0.5, 0.0))
    program = replace(program, modes=np.array([[STICK, STICK]]), mu=np.array([[0.34, 0.01]]))
    assert feasibility.explain(program, 0) is not None
    assert feasibility.explain(program, 0, hard=False) is None
    feasibility.check(program, hard=False)


def test_a_push_whose_friction_is_short_names_the_object():
    """Pushed down at 45° to the outward side with a ground that holds: f_t / f_n of the object decides."""
    program, foot = pivot(mu=(5.0, 0.01), contact=(0.0065, 0.063))
    found = feasibility.explain(program, 0)
    assert found is not None
    assert found.contact == "object"
    arm = np.array([0.0065, 0.063]) - foot
    n = program.eo_jacobian[0, 1, 0, :2]
    lever_n, lever_t = arm[0] * n[1] - arm[1] * n[0], arm[0] * -n[0] - arm[1] * n[1]
    assert found.needs > abs(lever_n / lever_t)  # less, and the push turns it the wrong way however strong


def test_pushing_a_block_that_slides_needs_the_grounds_friction_that_its_weight_asks_for():
    """3 N along a ground that bears 0.5 kg: µ m g = 3 N, µ = 0.61; the object may press down and up by its own cone."""
    weight = 0.5 * 9.81
    feet = [(-0.06, -0.03), (0.06, -0.03)]
    program = standing(feet, (-0.06, 0.0), (1.0, 0.0), (SLIP_MINUS, SLIP_MINUS, STICK), (0.33, 0.0), weight=weight)
    held = np.array([[False, False], [False, False], [True, False]])
    found = feasibility.explain(program, 0, held=held)
    assert found is not None
    assert found.contact.startswith("ground")
    np.testing.assert_allclose(found.needs, 3.0 / weight, rtol=1e-4)
    assert feasibility.explain(program, 0) is None  # with less force it slides


def test_two_pairs_that_are_both_short_are_both_named():
    """1 N into the wall of a block, 0.3 N down along it: 0.3 at the object, 1 N by weight and 0.3 N below."""
    feet = [(-0.06, -0.03), (0.06, -0.03)]
    modes = (STICK, STICK, STICK)
    program = standing(feet, (-0.06, 0.0), (1.0, 0.0), modes, (0.01, 0.01), wish=(1.0, 0.3))
    found = feasibility.explain(program, 0, held=np.array([[False, False], [False, False], [True, True]]))
    assert found is not None
    ground = 1.0 / (WEIGHT + 0.3)
    assert found.reason == f"needs µ ≥ {ground:.3g} at the ground and µ ≥ 0.3 at the object, has 0.01 and 0.01"
    np.testing.assert_allclose(found.needs, ground, rtol=1e-5)


def test_a_force_through_the_pivot_is_told_apart():
    """A box on its corner foot, pushed straight at the foot: no friction of the ground, and little of the object's."""
    foot, contact = np.array([0.04, -0.05]), np.array([-0.04, 0.03])
    along = (foot - contact) / np.linalg.norm(foot - contact)
    program = standing([foot], contact, along, (STICK, SLIP_PLUS), (0.33, 0.0))
    found = feasibility.explain(program, 0)
    assert found is not None
    assert found.contact == "object"
    assert np.isinf(found.needs)
    assert "passes through the pivot, 'ground right'" in str(found.error())


def test_a_body_that_would_have_to_be_held_down_pulls():
    program = standing([(-0.04, -0.05), (0.04, -0.05)], (0.0, 0.05), (0.0, -1.0), (STICK, STICK, FREE))
    found = feasibility.explain(replace(program, eo_load=np.array([[0.0, 2.0, 0.0]])), 0)
    assert found is not None
    assert np.isinf(found.needs)
    assert "pull" in found.reason


def test_no_contact_holds_nothing():
    program = standing([(0.0, -0.05)], (0.0, 0.05), (0.0, -1.0), (FREE, FREE))
    assert "no contact" in feasibility.explain(program, 0).reason


@pytest.mark.parametrize(
    ("wish", "mode", "needs", "words"),
    [
        ((3.0, 1.5), STICK, 0.5, None),
        ((3.0, -1.5), STICK, 0.5, None),
        ((-1.0, 0.0), STICK, np.inf, "pulls"),
        ((-1.0, -0.33), SLIP_PLUS, np.inf, "pulls"),
    ],
)
def test_in_p2_it_is_the_wish_that_fails(wish, mode, needs, words):
    program = ContactProgram(("ground",), np.array([[mode]]), [[wish]], [[0.33]], [[[1.0, 1.0]]], (False,))
    found = feasibility.explain(program, 0)
    assert found is not None
    np.testing.assert_allclose(found.needs, needs)
    assert words is None or words in found.reason
    with pytest.raises(InfeasiblePlan, match=r"step 0"):
        feasibility.check(program)


def test_in_p2_a_wish_inside_its_cone_lacks_nothing():
    program = ContactProgram(("ground",), np.array([[STICK]]), [[[3.0, 0.9]]], [[0.33]], [[[1.0, 1.0]]], (False,))
    assert feasibility.explain(program, 0) is None
    feasibility.check(program)


# --- robustness ---


def test_more_or_less_push_moves_the_margins_as_statics_says():
    """On one foot the ground answers alone: N' = N + d, T' = T + d ê in the axes of W, at every step."""
    program, foot = pivot(mu=(0.6, 0.33), steps=3)
    contact = np.array([-0.0065, 0.063])
    towards = (foot - contact) / np.linalg.norm(foot - contact)
    wrench = np.array([*towards, contact[0] * towards[1] - contact[1] * towards[0]])
    found = feasibility.margins(program, np.tile(wrench, (3, 1)), sizes=(-0.5, 0.0, 0.5))
    assert found.margin.shape == found.needs.shape == (3, 3, 2)
    nominal = found.forces[1]
    for s, size in enumerate((-0.5, 0.5)):
        change = found.forces[2 * s] - nominal
        ground = -size * towards[::-1]  # n is +y, t is +x; the ground pushes back
        np.testing.assert_allclose(change[:, 0], np.tile(ground, (3, 1)), atol=1e-7)
    normal, side = found.forces[..., 0], np.abs(found.forces[..., 1])
    np.testing.assert_allclose(found.margin, (found.has * normal - side) / np.sqrt(1 + found.has**2), atol=1e-12)
    np.testing.assert_allclose(found.needs[:, :, 0], (side / normal)[:, :, 0])
    assert found.holds == bool(found.margin.min() >= 0)
    assert found.margin[found.worst] == found.margin.min()


def test_a_push_that_is_weaker_than_the_disturbance_loses_its_contact():
    """Pushed down with 3 N a change of 2 N leaves 1 N; pushed with 1 N it would have to pull with 1 N."""
    feet = [(-0.04, -0.05), (0.04, -0.05)]
    wrench = np.array([[0.0, -1.0, 0.0]])
    found = {}
    for push in (1.0, 3.0):
        program = standing(feet, (0.0, 0.05), (0.0, -1.0), (STICK, STICK, STICK), wish=(push, 0.0))
        found[push] = feasibility.margins(program, wrench, sizes=(-2.0, 2.0), forces=program.desired)
    assert found[3.0].holds
    assert not found[1.0].holds
    assert found[1.0].worst == (0, 0, 2)
    np.testing.assert_allclose(found[1.0].forces[:, 0, 2, 0], [-1.0, 3.0], atol=1e-9)


def test_where_the_feet_have_a_choice_the_least_margin_is_made_as_large_as_it_can_be():
    """4 N straight down between two feet: 2 N each and no squeeze leaves 2 µ / √(1 + µ²) N to either edge."""
    feet = [(-0.04, -0.05), (0.04, -0.05)]
    program = standing(feet, (0.0, 0.05), (0.0, -1.0), (STICK, STICK, STICK), wish=(3.0, 0.0), weight=1.0)
    found = feasibility.margins(program, np.array([[0.0, -1.0, 0.0]]), sizes=(0.0,), forces=program.desired)
    np.testing.assert_allclose(found.margin[0, 0, :2], 2 * 0.33 / np.hypot(1, 0.33), atol=1e-6)


def test_a_free_contact_has_no_margin_to_lose_and_p2_is_refused():
    program = standing([(-0.04, -0.05), (0.04, -0.05)], (0.0, 0.05), (0.0, -1.0), (STICK, STICK, FREE))
    found = feasibility.margins(program, np.zeros((1, 3)))
    assert np.isinf(found.margin[..., 2]).all()
    with pytest.raises(ValueError, match="extrinsic object"):
        feasibility.margins(replace(program, eo_jacobian=None, eo_load=None), np.zeros((1, 3)))
