"""How far the fingers are moved to find their stiffness: by a force, unless the arm's own error would drown that."""

import numpy as np
import pytest

from experiments.calibrate.elasticity import amplitudes, drift_order, schedule, too_short
from experiments.calibrate.schema import ElasticityStage
from mechanics.catalogue import load_sensor


def test_soft_fingers_are_moved_by_the_force_that_is_asked():
    stage = ElasticityStage(stage="calibrate_elasticity", force=6.0, torque=0.2)
    x, y, angle = amplitudes(stage, load_sensor("soft_bubble").stiffness)
    assert x == pytest.approx(6 / 2208.96)
    assert y == pytest.approx(6 / 1875.92)
    assert angle == pytest.approx(0.2 / (1608.49 * 0.0448**2))


def test_stiff_fingers_are_moved_ten_times_further_than_an_arm_repeats_itself():
    stage = ElasticityStage(stage="calibrate_elasticity")
    x, y, angle = amplitudes(stage, load_sensor("gelslim").stiffness)
    # 0.1 mm and 0.1°, the repeatability that makers warrant
    assert min(x, y) >= 10 * 1e-4
    assert angle >= 10 * np.radians(0.1)


def test_no_finger_is_pushed_harder_than_the_stage_allows():
    stage = ElasticityStage(
        stage="calibrate_elasticity", least_mm=10.0, least_deg=20.0, most_force=9.0, most_torque=0.5
    )
    stiffness = np.diag([5000.0, 10000.0, 40.0])
    assert (amplitudes(stage, stiffness) * np.diag(stiffness) <= np.array([9.0, 9.0, 0.5]) * (1 + 1e-12)).all()


def test_no_least_is_asked_where_it_is_zero():
    stage = ElasticityStage(stage="calibrate_elasticity", least_mm=0.0, least_deg=0.0)
    stiffness = np.diag([5000.0, 10000.0, 40.0])
    np.testing.assert_allclose(amplitudes(stage, stiffness), [6 / 5000, 6 / 10000, 0.2 / 40])


def test_a_third_of_the_holds_lie_along_one_axis_and_none_is_short():
    stage = ElasticityStage(stage="calibrate_elasticity", samples=90)
    stiffness = load_sensor("soft_bubble").stiffness
    holds, vias = schedule(stage, stiffness, np.random.default_rng(3))
    shares = np.abs(holds) / amplitudes(stage, stiffness)
    axial = (shares > 0).sum(axis=1) == 1
    assert axial.sum() == 30
    np.testing.assert_array_equal((shares[axial] > 0).sum(axis=0), [10, 10, 10])
    assert shares[shares > 0].min() >= 0.5
    assert shares.max() <= 1.0
    octants = np.unique(np.sign(holds[~axial]), axis=0)
    assert len(octants) == 8  # every direction is gone to
    assert vias.shape == holds.shape


def test_a_drift_may_bend_no_faster_in_a_short_session_than_in_a_long_one():
    # eight orders in the nine minutes of 200 samples; in two minutes as many would follow the fingers' creep of 8 s
    assert [drift_order(span) for span in (20.0, 107.0, 533.0, 5000.0)] == [1, 2, 8, 8]


def test_holds_too_short_for_the_creep_are_told():
    assert too_short(15.0, 8.0) == too_short(0.4, 0.0) == ""
    assert "in holds of 3 s slower creep passes for stiffness" in too_short(3.0, 2.8)
