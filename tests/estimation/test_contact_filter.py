"""The Contact Particle Filter: better than one wrench, patient while they are ambiguous, quick when they are not."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import pytest

from estimation.contact_filter import ContactFilter, systematic
from estimation.contact_location import ContactEstimate, ContactLocator, ContactStatus
from estimation.contact_sites import ground_seen_by
from estimation.contact_wrench import EnvironmentWrench
from experiments.bench.contact import OUTLINES, touches
from mechanics import se2

from .contact_cases import MU, covariance, measured

BOX, U = OUTLINES["tall_box"], OUTLINES["U"]
DT = 1 / 30
#: outer side of the U's left prong, and the inner side of its right one, which a push to the right meets as well
OUTER_LEFT, INNER_RIGHT = 7, 3
LEFT = U.vertices[:, 0].min()


def particles(outline, seed=0, **figures) -> ContactFilter:
    return ContactFilter(ContactLocator(outline, MU), np.random.default_rng(seed), **figures)


def fed(follow: ContactFilter, wrenches: Iterable[EnvironmentWrench]) -> ContactEstimate:
    """What the filter says after the last of the wrenches."""
    return [follow.update(DT, wrench) for wrench in wrenches][-1]


def weight_on(estimate, face: int) -> float:
    return sum(h.weight for h in estimate.hypotheses if h.face == face)


def test_thirty_wrenches_locate_a_contact_better_than_one():
    rng = np.random.default_rng(0)
    true = touches(BOX, 60, rng)
    once, finally_ = [], []
    for i, (point, force) in enumerate(zip(true.points, true.forces, strict=True)):
        follow = particles(BOX, i)
        for errors, count in ((once, 1), (finally_, 29)):
            best = fed(follow, (measured(point, force, rng) for _ in range(count))).hypotheses[0]
            errors.append(np.linalg.norm(best.point - point))
    assert np.median(once) < 0.7e-3
    assert np.median(finally_) < 0.8 * np.median(once)
    assert np.quantile(finally_, 0.95) < 1.2e-3


def test_a_contact_that_slides_is_followed_round_a_corner():
    rng = np.random.default_rng(1)
    follow = particles(BOX)
    x, y = end = np.array([0.025, -0.07345])
    # 10 mm/s along the bottom to its right end
    found = fed(follow, (measured([x + s, y], [0.0, 3.0], rng) for s in np.linspace(-0.03, 0.0, 90)))
    assert found.status is ContactStatus.OK and np.linalg.norm(found.hypotheses[0].point - end) < 2e-3
    for s in np.linspace(0.0, 0.03, 90):  # and up the right side
        found = follow.update(DT, measured([x, y + s], [-3.0, 0.0], rng))
        if s > 0.006:
            assert found.contact is not None and found.contact.face == 1
            assert np.linalg.norm(found.contact.point - end - [0.0, s]) < 3e-3


def test_two_faces_that_explain_every_wrench_are_both_kept():
    rng = np.random.default_rng(2)
    follow = particles(U)
    statuses = []
    for _ in range(600):  # twenty seconds
        found = follow.update(DT, measured([LEFT, 0.03], [3.0, 0.2], rng))
        statuses.append(found.status)
        assert weight_on(found, OUTER_LEFT) > 0 and weight_on(found, INNER_RIGHT) > 0
    assert np.mean([status is ContactStatus.AMBIGUOUS for status in statuses]) > 0.9


@pytest.mark.parametrize("seed", range(5))
def test_a_turn_of_the_force_tells_the_place_that_stays_from_the_one_that_would_slide(seed):
    rng = np.random.default_rng(seed)
    follow = particles(U, seed)
    leans = np.concatenate([np.zeros(30), np.linspace(0, np.arctan(MU) * 0.9, 20)])
    forces = 3 * np.stack([np.cos(leans), -np.sin(leans)], axis=-1)
    found = fed(follow, (measured([LEFT, 0.04], force, rng) for force in forces))
    # the inner face would have to slide by 70 mm · tan 17° = 21 mm in two thirds of a second
    assert found.contact is not None and found.contact.face == OUTER_LEFT
    assert found.contact.point == pytest.approx([LEFT, 0.04], abs=0.003)


def test_a_slide_past_the_end_of_the_rival_decides():
    rng = np.random.default_rng(4)
    follow = particles(U)
    # the inner face ends at the bottom of the dent, 20 mm higher
    found = fed(follow, (measured([LEFT, y], [3.0, 0.0], rng) for y in np.linspace(0.02, -0.03, 150)))
    assert found.contact is not None and found.contact.face == OUTER_LEFT


def test_a_contact_that_jumps_is_found_at_once():
    rng = np.random.default_rng(5)
    follow = particles(BOX)
    for _ in range(30):
        follow.update(DT, measured([0.01, -0.07345], [0.0, 3.0], rng))
    found = follow.update(DT, measured([-0.025, 0.02], [3.0, 0.0], rng))
    assert found.contact is not None and found.contact.face == 3
    assert np.linalg.norm(found.contact.point - [-0.025, 0.02]) < 3e-3


def test_a_corner_on_the_floor_is_followed_with_the_floors_cone():
    rng = np.random.default_rng(6)
    follow = particles(BOX)
    for tilt in np.linspace(0.3, 0.7, 40):  # it pivots about its lower left corner
        pose = np.array([0.1, -BOX.transformed((0.0, 0.0, tilt)).vertices[:, 1].min(), tilt])
        force = se2.rotate(-tilt, np.array([0.0, 3.0]))
        found = follow.update(DT, measured(BOX.vertices[0], force, rng), [ground_seen_by(pose)])
        assert found.status is ContactStatus.OK
        assert np.linalg.norm(found.hypotheses[0].point - BOX.vertices[0]) < 4e-3
        if tilt > 0.45:  # neither face's own cone holds the force any more
            assert found.hypotheses[0].vertex == 0
            assert found.hypotheses[0].force == pytest.approx(force, abs=0.1)


def test_the_spread_of_the_particles_is_honest():
    rng = np.random.default_rng(7)
    squared = []
    for i in range(60):
        follow = particles(BOX, i)
        # the walk it believes in, away from the corners
        s = rng.uniform(-0.01, 0.01) + np.cumsum(0.003 * np.sqrt(DT) * rng.standard_normal(15))
        best = fed(follow, (measured([at, -0.07345], [0.0, 3.0], rng) for at in s)).hypotheses[0]
        assert best.face == 0
        squared.append((best.point[0] - s[-1]) ** 2 / best.deviation**2)
    assert 0.6 < np.mean(squared) < 1.6


def test_the_same_seed_gives_the_same_answers():
    def answers():
        rng, follow = np.random.default_rng(8), particles(U, 9)
        found = fed(follow, (measured([LEFT, 0.03], [3.0, 0.2], rng) for _ in range(10)))
        return [(h.face, h.weight, *h.point) for h in found.hypotheses]

    assert answers() == answers()


NAN = EnvironmentWrench(np.array([np.nan, 3.0, 0.0]), np.eye(3), np.zeros(2))


@pytest.mark.parametrize(
    ("wrench", "status"),
    [
        (None, ContactStatus.NO_WRENCH),
        (EnvironmentWrench.of(np.zeros(3), covariance()), ContactStatus.NO_WRENCH),
        (NAN, ContactStatus.INVALID),
        (measured([0.06, 0.0], [0.0, 3.0]), ContactStatus.UNEXPLAINED),
    ],
)
def test_a_wrench_that_says_nothing_is_a_status_and_unsettles_no_weight(wrench, status):
    rng = np.random.default_rng(10)
    follow = particles(BOX)
    assert follow.update(DT, wrench).status is status  # before anything is known, too
    for _ in range(10):
        follow.update(DT, measured([0.01, -0.07345], [0.0, 3.0], rng))
    for _ in range(3):
        found = follow.update(DT, wrench)
        assert found.status is status and found.contact is None and not found.hypotheses
    again = follow.update(DT, measured([0.01, -0.07345], [0.0, 3.0], rng))
    assert again.contact is not None and np.linalg.norm(again.contact.point - [0.01, -0.07345]) < 3e-3


def test_no_time_between_two_wrenches_is_no_error():
    follow = particles(BOX)
    follow.update(0.0, measured([0.01, -0.07345], [0.0, 3.0]))
    found = follow.update(0.0, measured([0.01, -0.07345], [0.0, 3.0]))
    assert found.contact is not None and found.contact.point == pytest.approx([0.01, -0.07345], abs=1e-3)


@pytest.mark.parametrize("figures", [{"particles": 5}, {"walk": -1.0}, {"jumps": 0.0}, {"memory": np.nan}])
def test_figures_that_mean_nothing_are_refused(figures):
    with pytest.raises(ValueError, match="ContactFilter"):
        particles(BOX, **figures)


@pytest.mark.parametrize("dt", [-1.0, np.nan])
def test_time_does_not_run_backward(dt):
    with pytest.raises(ValueError, match="dt"):
        particles(BOX).update(dt, None)


def test_systematic_resampling_draws_each_to_within_one_of_its_share():
    rng = np.random.default_rng(11)
    weights = rng.uniform(size=30)
    weights /= weights.sum()
    counts = np.bincount(systematic(weights, 200, rng), minlength=30)
    assert counts.sum() == 200 and np.abs(counts - 200 * weights).max() < 1
