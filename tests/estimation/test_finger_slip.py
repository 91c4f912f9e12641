"""What is no slip in the fingers, and what is: against a finger by hand whose K is not the believed one."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.finger_slip import FingerSlip, SlipNoise
from mechanics import se2
from mechanics.elasticity import Elasticity
from mechanics.records import PlanarState

K = np.diag([2000.0, 2000.0, 3.2])
GRASP = np.array([0.0, 0.045, 0.1])
#: how the object truly lies in the fingers
LIES = np.array([1.2e-3, -0.4e-3, -0.03])


def held(w, *, stiffer=1.0, slid=(0.0, 0.0, 0.0), ee=(0.1, 0.2, 0.3), lies=LIES):
    """The state in which fingers of ``stiffer`` · K, that hold the object off by ``lies``, bear ``w`` (3,) in gocf,
    after it has ``slid`` (3,): poses by composition, the wrench about the planned grasp on the go."""
    held_at = se2.compose(np.array(slid, float), lies)
    x = np.linalg.solve(stiffer * K, np.array(w, float))
    gocf = se2.compose(np.array(ee, float), se2.inverse(x))
    planned = se2.compose(gocf, held_at)  # where the plan has the grasp, as the fingers hold it
    go = se2.compose(planned, se2.inverse(GRASP))
    c, s = np.cos(gocf[2]), np.sin(gocf[2])
    force = np.array([c * w[0] - s * w[1], s * w[0] + c * w[1]])
    arm = gocf[:2] - planned[:2]
    return PlanarState(np.array(ee, float), go, None, np.append(force, w[2] + arm[0] * force[1] - arm[1] * force[0]))


@pytest.fixture
def slip():
    found = FingerSlip(GRASP, Elasticity(K))
    found.hangs(held([0.0, 1.0, 0.0]))
    return found


@pytest.mark.parametrize("w", [(0.0, -4.0, 0.0), (3.0, -5.0, 0.1), (-6.0, 2.0, -0.2)])
def test_what_elasticity_explains_is_no_drift_wherever_the_arm_is(slip, w):
    for ee in ((0.1, 0.2, 0.3), (-0.2, 0.3, -0.7)):
        drift = slip.drift(held(w, ee=ee))
        assert drift.moved == pytest.approx([0, 0, 0], abs=1e-5) and not drift.slipped


def test_a_slip_is_told_by_how_far_and_how_many_sigmas(slip):
    drift = slip.drift(held([0.0, -4.0, 0.0], slid=(0.8e-3, -0.6e-3, 0.01)))
    assert drift.moved == pytest.approx([0.8e-3, -0.6e-3, 0.01], abs=1e-6)
    assert drift.size_mm == pytest.approx(1.0, abs=1e-3) and drift.size_deg == pytest.approx(0.573, abs=1e-3)


def test_creep_by_a_tenth_of_a_millimetre_at_a_time_adds_up_to_a_slip(slip):
    found = [slip.drift(held([0.0, -1.0, 0.0], slid=(0.0, n * 1e-4, 0.0))).slipped for n in range(16)]
    # 4 sigma of 0.15 mm for looks and a tenth of x = 1 mm
    assert found == [n * 1e-4 > 4 * np.hypot(1.5e-4, 1e-4) for n in range(16)]


@pytest.mark.parametrize("stiffer", [0.8, 1.25])
def test_a_stiffness_that_is_a_quarter_off_is_no_slip_under_any_force(slip, stiffer):
    slip.hangs(held([0.0, 1.0, 0.0], stiffer=stiffer))
    for force in (2.0, 8.0, 20.0):
        assert not slip.drift(held([0.0, -force, 0.0], stiffer=stiffer)).slipped


def test_what_a_sensor_leaves_open_is_no_slip(slip):
    blind = np.diag([2e-3, 1e-6, 1e-4]) ** 2  # along x it sees next to nothing
    slip.hangs(held([0.0, 1.0, 0.0]), blind)
    assert not slip.drift(held([0.0, -2.0, 0.0], slid=(3e-3, 0.0, 0.0)), blind).slipped
    assert slip.drift(held([0.0, -2.0, 0.0], slid=(0.0, 1.5e-3, 0.0)), blind).slipped


def test_the_displacement_alone_tells_the_wrench(slip):
    state = held([3.0, -5.0, 0.1])
    silent = PlanarState(state.ee, state.go, None, np.zeros(3))  # a wrist sensor that is wrong and does not know it
    drift = slip.drift(silent)
    c, s = np.cos(0.3), np.sin(0.3)
    assert drift.wrench[:2] == pytest.approx([3 * c + 5 * s, 3 * s - 5 * c], abs=0.4)  # turned by x with gocf
    assert drift.wrench[2] == pytest.approx(0.1, abs=1e-3)


def test_nothing_is_known_before_a_look_in_free_air_nor_of_a_go_that_is_not_seen():
    slip = FingerSlip(GRASP, Elasticity(K), SlipNoise())
    state = held([0.0, -4.0, 0.0])
    unseen = PlanarState(state.ee, None, None, state.wrench)
    assert slip.drift(state) is None
    slip.hangs(unseen)
    assert slip.drift(state) is None
    slip.hangs(state)
    assert slip.drift(unseen) is None
    broken = PlanarState(state.ee * np.nan, state.go, None, state.wrench)
    assert slip.drift(broken) is None
