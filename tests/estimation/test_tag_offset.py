"""How a tag sits on its object, from touches on the table and from what the fingers feel."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.errors import FitError
from estimation.tactile_pose import ANGLE_LENGTH
from estimation.tag_offset import BELIEF, Tactile, TagOffset, Touch, fit_tag_offset
from mechanics import se2

BOX = np.array([[-0.025, -0.0735], [0.025, -0.0735], [0.025, 0.0735], [-0.025, 0.0735]])
BELIEVED = np.array([0.0, -0.04, 0.0])
TRUE = np.array([0.0008, -0.0411, 0.02])


def resting(corners: tuple[int, ...], tilt: float, x: float = 0.05, tag: np.ndarray = TRUE, **known) -> Touch:
    """The box turned by ``tilt`` with the first of ``corners`` on the ground."""
    X_T_go = np.array([x, 0.0, tilt])
    X_T_go[1] -= se2.transform(X_T_go, BOX[corners[0]])[1]
    return Touch(se2.compose(X_T_go, tag), corners, **known)


def open_axes(fit: TagOffset) -> np.ndarray:
    """|(x, y, θ)| share of what is unobserved."""
    return np.sqrt(np.sum(fit.unobserved**2, axis=0))


def test_a_face_on_the_table_gives_angle_and_height_and_leaves_the_place_along_it_as_believed() -> None:
    fit = fit_tag_offset(BOX, [resting((0, 1), 0.0)], BELIEVED)
    assert fit.pose == pytest.approx((BELIEVED[0], TRUE[1], TRUE[2]), abs=1e-4)
    assert fit.unobserved.shape == (1, 3)
    assert open_axes(fit) == pytest.approx((1, 0, 0), abs=1e-3)
    sigma = np.sqrt(np.diag(fit.covariance))
    assert sigma[0] == pytest.approx(BELIEF[0], rel=1e-3)
    # 0.1 mm at each end of 50 mm, the ground itself 0.07 mm and 0.4 mrad, 40 mm from the tag
    assert sigma[1] == pytest.approx(np.hypot(1e-4 / np.sqrt(2), np.hypot(7e-5, 4e-4 * 0.05)), rel=0.05)
    assert sigma[2] == pytest.approx(np.hypot(1e-4 * np.sqrt(2) / 0.05, 4e-4), rel=0.02)


def test_two_faces_give_all_of_it() -> None:
    fit = fit_tag_offset(BOX, [resting((0, 1), 0.0), resting((1, 2), -np.pi / 2)], BELIEVED)
    assert fit.pose == pytest.approx(TRUE, abs=2e-4)
    assert fit.unobserved.shape == (0, 3)
    assert np.sqrt(fit.covariance[0, 0]) < 2e-4


@given(st.floats(0.2, 0.6), st.tuples(st.floats(-2, 2), st.floats(-2, 2), st.floats(-2, 2)))
@settings(max_examples=30)
def test_a_face_and_its_two_ends_give_all_of_it_without_letting_go(tilt: float, off: tuple[float, ...]) -> None:
    tag = BELIEVED + np.array(off) * BELIEF
    sightings = [resting((0, 1), 0.0, tag=tag), resting((0,), tilt, tag=tag), resting((1,), -tilt, tag=tag)]
    fit = fit_tag_offset(BOX, sightings, BELIEVED)
    assert fit.unobserved.shape == (0, 3)
    # the belief pulls by its share of the information
    assert (fit.pose - tag) @ np.linalg.solve(fit.covariance, fit.pose - tag) < 0.2
    assert np.sqrt(fit.covariance[0, 0]) < 0.0003 / np.sin(tilt)


def test_one_corner_leaves_two_directions_open() -> None:
    fit = fit_tag_offset(BOX, [resting((1,), -0.3)], BELIEVED)
    assert fit.unobserved.shape == (2, 3)


def test_the_covariance_is_that_of_repeated_touches() -> None:
    tag_sigma, level, ground, scores = np.array([3e-5, 4e-5, 4e-4]), 8e-5, (1e-4, 5e-4), []
    rng = np.random.default_rng(0)
    for _ in range(100):
        tag = BELIEVED + BELIEF * rng.standard_normal(3)
        sightings, sunk = [], np.array([0.0, *ground * rng.standard_normal(2)])
        for corners, tilt in (((0, 1), 0.0), ((0,), 0.4), ((1,), -0.4), ((1,), -0.3)):
            exact = resting(corners, tilt, tag=tag)
            raised = exact.X_T_tag + tag_sigma * rng.standard_normal(3)
            raised[1] += level * rng.standard_normal()
            if len(corners) == 2:  # one end lies on a grain more than the other
                X_T_go = se2.compose(raised, se2.inverse(tag))
                grain = level * np.sqrt(2) * rng.standard_normal() / 0.05
                turned = se2.compose(np.array([0, 0, grain]), se2.compose(se2.inverse(np.array([0.05, 0, 0])), X_T_go))
                raised = se2.compose(se2.compose(np.array([0.05, 0, 0]), turned), tag)
            sightings.append(Touch(se2.compose(sunk, raised), corners, np.diag(tag_sigma**2), level))
        fit = fit_tag_offset(BOX, sightings, BELIEVED, ground=ground)
        error = fit.pose - tag
        scores.append(error @ np.linalg.solve(fit.covariance, error) / 3)
    assert 0.6 < np.mean(scores) < 1.2  # a face that lies flat is laid to two grains where there was one and its height


def test_a_tactile_pose_gives_what_it_knows_and_no_more() -> None:
    X_ee_go = np.array([0.001, -0.045, 0.4])
    information = np.diag([1e10, 1e10, 1e8])
    whole = fit_tag_offset(BOX, [Tactile(X_ee_go, information, se2.compose(X_ee_go, TRUE))], BELIEVED)
    assert whole.pose == pytest.approx(TRUE, abs=1e-5)
    assert len(whole.unobserved) == 0
    # two parallel sides: nothing along the object's own y, which lies at 0.4 rad in the ee
    along = np.array([-np.sin(0.4), np.cos(0.4), 0.0])
    blind = information - 1e10 * np.outer(along, along)
    part = fit_tag_offset(BOX, [Tactile(X_ee_go, blind, se2.compose(X_ee_go, TRUE))], BELIEVED)
    assert open_axes(part) == pytest.approx((0, 1, 0), abs=0.02)
    assert part.pose[1] == pytest.approx(BELIEVED[1], abs=1e-4)
    assert part.pose[0] == pytest.approx(TRUE[0], abs=1e-4)
    both = fit_tag_offset(BOX, [Tactile(X_ee_go, blind, se2.compose(X_ee_go, TRUE)), resting((0, 1), 0.0)], BELIEVED)
    assert both.pose == pytest.approx(TRUE, abs=1e-4)
    assert len(both.unobserved) == 0


def test_the_derivative_of_a_tactile_sighting_is_that_of_finite_differences() -> None:
    from estimation.tag_offset import _tactile, _touch

    sighting = Tactile(np.array([0.02, -0.05, 0.7]), np.eye(3), np.array([0.05, -0.06, 0.75]))
    touch = resting((0, 1), 0.3)
    X = se2.compose(se2.inverse(sighting.X_ee_go), sighting.X_ee_tag)
    for residual, at in ((lambda x: _tactile(sighting, x), X), (lambda x: _touch(BOX[:2], touch, x), TRUE + 0.01)):
        numeric = np.stack([(residual(at + h)[0] - residual(at - h)[0]) / 2e-6 for h in 1e-6 * np.eye(3)], axis=1)
        np.testing.assert_allclose(residual(at)[1], numeric, atol=1e-8)


def test_sightings_that_contradict_each_other_are_told() -> None:
    with pytest.raises(FitError, match="which corner really touched"):
        fit_tag_offset(BOX, [resting((0, 1), 0.0), resting((1, 2), 0.0)], BELIEVED)


@pytest.mark.parametrize(
    ("sightings", "word"),
    [
        ([], "none"),
        ([Touch(TRUE, ())], "touch 0"),
        ([resting((0, 1), 0.0), Touch(TRUE, (4,))], r"corners 0 to 3.*touch 1"),
        ([Touch(np.array([0, np.nan, 0]), (0, 1))], "NaN in sighting 0"),
        ([Tactile(TRUE, np.full((3, 3), np.nan), TRUE)], "NaN in sighting 0"),
    ],
)
def test_what_is_no_sighting_is_told(sightings: list, word: str) -> None:
    with pytest.raises(FitError, match=word):
        fit_tag_offset(BOX, sightings, BELIEVED)


def test_unobserved_directions_are_of_unit_length_with_angles_as_lengths() -> None:
    fit = fit_tag_offset(BOX, [resting((0,), 0.3)], BELIEVED)
    np.testing.assert_allclose(fit.unobserved @ fit.unobserved.T, np.eye(2), atol=1e-12)
    blind = fit.unobserved * (1, 1, 1 / ANGLE_LENGTH)  # as steps of (x, y, θ)
    assert np.abs(blind @ fit.information @ blind.T).max() < 1e-6 * np.abs(fit.information).max()
