"""Tactile poses from Soft Bubbles: against the simulated membrane's truth, with the `lab` profile's noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from drivers.sim.mismatch import load_profile
from estimation.deformation import Unusable
from estimation.tactile_pose import FingerModel, GraspPrior, PoseStatus, left_difference
from estimation.tactile_pose_icp import CannyIcp
from estimation.tactile_pose_strips import RidgeStrips
from experiments.bench.tactile import GRASPS, Family, Hand, Row, accuracy, random_grasps, soft_bubble
from mechanics import se2
from mechanics.catalogue import load_object
from mechanics.polygon import Polygon

BOX = load_object("tall_box").polygon
PRIOR = GraspPrior(np.array([0.0, -0.045, 0.0]))
TRUE = np.array([0.001, -0.044, 0.02])


def keeps_its_word(row: Row) -> None:
    assert row.rms_mm <= 0.3 and row.rms_deg <= 0.5
    assert row.far <= 0.01
    assert row.flagged == 1.0
    assert 0.6 <= row.nees_median <= 1.7
    assert row.nees_mean < 2.0


def measured(family: Family, count: int, seed: int, places=None) -> tuple[Row, Row]:
    """The paper's own method, and the better one."""
    icp, strips = accuracy("bubble", random_grasps(family, count, seed, places), seed, {"bubble": family})
    assert (icp.method, strips.method) == (CannyIcp.name, RidgeStrips.name)
    return icp, strips


def test_default_grasp_is_found_and_the_baseline_stands_behind() -> None:
    icp, strips = measured(soft_bubble(), 16, 11)
    assert strips.rms_mm <= 0.3 and strips.rms_deg <= 0.6 and strips.far == 0.0
    assert strips.nees_mean < 2.0
    assert icp.rms_mm > 3 * strips.rms_mm


def test_shapes_of_all_kinds_are_found_where_their_edges_show() -> None:
    _, strips = measured(soft_bubble(), 22, 12, GRASPS)
    assert strips.rms_mm <= 0.3 and strips.rms_deg <= 0.5 and strips.far == 0.0
    assert strips.silent < 0.1 and strips.nees_mean < 2.0


def test_along_two_parallel_sides_the_pose_is_the_priors_and_says_so() -> None:
    family = replace(soft_bubble(), indentations=(0.016,))
    grasps = random_grasps(family, 4, 5, {"tall_box": ((0.0, 0.0, 0.0),)})
    _, strips = accuracy("bubble", grasps, 5, {"bubble": family})
    assert strips.open >= 1 and strips.flagged == 1.0


@pytest.mark.slow
@pytest.mark.parametrize("places", [None, GRASPS], ids=["default grasp", "all shapes"])
def test_two_hundred_grasps_keep_the_word(places) -> None:
    _, strips = measured(soft_bubble(), 200, 1, places)
    keeps_its_word(strips)


@pytest.mark.slow
def test_a_stereo_camera_of_640_columns_keeps_the_word() -> None:
    _, strips = measured(soft_bubble(640, 480), 60, 2, GRASPS)
    assert strips.rms_mm <= 0.3 and strips.rms_deg <= 0.5 and strips.far <= 0.02
    assert strips.nees_mean < 2.0 and strips.flagged == 1.0


# -- one finger, and pictures of no use --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def hand() -> Hand:
    return Hand(load_profile("lab"), np.array(BOX.vertices), TRUE)


@pytest.fixture(scope="module")
def left(hand: Hand):
    device = soft_bubble().open(hand, "left", 0.015)
    return device, FingerModel.of(device.describe().extra, device.reference())


def test_the_fingers_agree_on_what_both_see(hand: Hand, left) -> None:
    right = soft_bubble().open(hand, "right", 0.015)
    poses = []
    for device, model in (left, (right, FingerModel.of(right.describe().extra, right.reference()))):
        pose = RidgeStrips(model, BOX).estimate(device.capture(), PRIOR)
        assert pose.status is PoseStatus.OK
        error = left_difference(pose.pose, TRUE)
        assert abs(error[1]) < 0.5e-3 and abs(error[2]) < np.radians(1.5)
        poses.append(pose)
    # the upper end of the box is what shows: kinks lie on it
    for pose in poses:
        own = se2.transform(se2.inverse(pose.pose), pose.edges)
        assert (np.abs(own[:, 1] - 0.07345) < 1e-3).mean() > 0.3


def test_an_equal_picture_gives_an_equal_pose(left) -> None:
    device, model = left
    image, method = device.capture(), RidgeStrips(model, BOX)
    np.testing.assert_array_equal(method.estimate(image, PRIOR).pose, method.estimate(image, PRIOR).pose)


@pytest.mark.parametrize("method", [RidgeStrips, CannyIcp])
def test_a_picture_of_no_use_gives_the_prior_and_its_reason(left, method) -> None:
    device, model = left
    image = device.capture()
    torn = image.image.copy()
    torn[80:] = model.reference[80:]
    for picture, status in (
        (np.zeros_like(torn), PoseStatus.BLANK),
        (torn, PoseStatus.TORN),
        (model.reference, PoseStatus.NO_CONTACT),
    ):
        pose = method(model, BOX).estimate(replace(image, image=picture), PRIOR)
        assert pose.status is status and pose.reason
        np.testing.assert_array_equal(pose.pose, PRIOR.pose)
        assert len(pose.unobserved) == 3


def test_an_outline_of_another_object_gives_no_pose(left) -> None:
    device, model = left
    image = device.capture()
    for other in (
        Polygon([[-0.012, -0.0734], [0.012, -0.0734], [0.012, 0.0734], [-0.012, 0.0734]]),
        Polygon([[-0.06, -0.09], [0.06, -0.09], [0.0, 0.055]]),
    ):
        assert RidgeStrips(model, other).estimate(image, PRIOR).status in (PoseStatus.MISMATCH, PoseStatus.NO_EDGE)


def test_nothing_held_is_no_contact(hand: Hand, left) -> None:
    device, model = left
    hand.held = False
    try:
        image = device.capture()
    finally:
        hand.held = True
    assert RidgeStrips(model, BOX).estimate(image, PRIOR).status is PoseStatus.NO_CONTACT


def test_contact_of_another_family_is_read_by_what_is_given(left) -> None:
    device, model = left

    class View:
        picture = np.zeros((171, 224), np.uint8)

        def points(self, pixels: ArrayLike) -> np.ndarray:
            # a pixel is half a millimetre, the picture's middle the finger's
            return (np.asarray(pixels, float) - (111.5, 85.0)) * 5e-4

    view = View()
    # the box's upper end, 3 mm to the right and 2 mm up of the prior: pixels are read as (x, y) of the finger
    view.picture[: int(85.0 + 61), int(111.5 - 44) : int(111.5 + 56)] = 255
    pose = CannyIcp(model, BOX, lambda image: view).estimate(device.capture(), PRIOR)
    assert pose.status is PoseStatus.OK
    np.testing.assert_allclose(pose.pose[:2], (0.003, -0.043), atol=1e-3)
    blind = CannyIcp(model, BOX, lambda image: Unusable(PoseStatus.BLANK, "dark")).estimate(device.capture(), PRIOR)
    assert (blind.status, blind.reason) == (PoseStatus.BLANK, "dark")
