"""The held object's pose from a GelSlim's pictures, against the pose that the picture was made of."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from drivers.sim.mismatch import load_profile
from estimation.gel_contact import GelContact
from estimation.tactile_pose import (
    FingerModel,
    GraspPrior,
    PoseStatus,
    TactilePose,
    fuse,
    left_difference,
    left_moved,
)
from estimation.tactile_pose_gel import GelReading, TactilePoseGel
from estimation.tactile_pose_icp import CannyIcp
from experiments.bench.tactile import Estimate, Grasp, random_grasps, row
from experiments.bench.tactile_gel import GRASPS, GelHand, gelslim, open_gelslim
from mechanics.polygon import Polygon
from mechanics.readings import ImageReading, Status

MM = 1e-3
BOX = Polygon(MM * np.array([(-12.0, -60), (12, -60), (12, 60), (-12, 60)]))
WEDGE = Polygon(MM * np.array([(-20.0, -50), (20, -50), (4, 50), (-4, 50)]))
#: shapes that no figure of the method was set on
STRANGERS = {
    "wedge": WEDGE,
    "L": Polygon(MM * np.array([(0.0, 0), (60, 0), (60, 18), (18, 18), (18, 80), (0, 80)])),
    "U": Polygon(
        MM * np.array([(-40.0, -40), (40, -40), (40, 40), (24, 40), (24, -24), (-24, -24), (-24, 40), (-40, 40)])
    ),
    "bar": Polygon(MM * np.array([(-5.0, -50), (5, -50), (5, 50), (-5, 50)])),
    "hexagon": Polygon(12 * MM * np.array([(np.cos(a), np.sin(a)) for a in np.arange(6) * np.pi / 3])),
    "arrow": Polygon(MM * np.array([(-30.0, -25), (0, -10), (30, -25), (0, 45)])),
}
END = np.array([0.0, -0.050, 0.0])  # the box held 10 mm below its end


def pose(x_mm: float = 0, y_mm: float = 0, degrees: float = 0) -> np.ndarray:
    return np.array([x_mm * MM, y_mm * MM, np.deg2rad(degrees)])


def looked(
    outline: Polygon,
    X_ee_go: np.ndarray,
    prior: GraspPrior,
    shear: np.ndarray | None = None,
    believed: Polygon | None = None,
    seed: int = 0,
    sides: tuple[str, ...] = ("left", "right"),
    indentation: float = 0.8e-3,
    **described: float,
) -> list[GelReading]:
    """What each finger says of one picture of the object."""
    hand = GelHand(load_profile("lab"), outline.vertices, X_ee_go, shear=pose() if shear is None else shear)
    out = []
    for k, side in enumerate(sides):
        device = open_gelslim(hand, side, indentation)
        device.restart(np.random.default_rng([seed, k]))
        finger = FingerModel.of(device.describe().extra | described, device.reference())
        out.append(TactilePoseGel(finger, believed or outline).read(device.capture(), prior))
    return out


def error(found: TactilePose, X_ee_go: np.ndarray) -> np.ndarray:
    """[mm, mm, deg]."""
    return left_difference(found.pose, X_ee_go) * (1e3, 1e3, np.degrees(1.0))


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    ("outline", "go", "off"),
    [
        (BOX, END, pose(3, -4, 5)),
        (BOX, pose(49, -7, 93), pose(-4, 3, -6)),
        (WEDGE, pose(2, -35, -4), pose(-3, -3, 4)),
    ],
    ids=["box", "box lying", "wedge"],
)
def test_a_pose_comes_back_to_some_hundredths_of_a_millimetre(side, outline, go, off) -> None:
    (found,) = looked(outline, go, GraspPrior(left_moved(go, off)), sides=(side,))
    assert found.pose.status is PoseStatus.OK
    x, y, angle = error(found.pose, go)
    assert np.hypot(x, y) < 0.08
    assert abs(angle) < 0.15
    assert len(found.pose.unobserved) == 0


def test_where_two_parallel_sides_show_the_way_along_them_is_unobserved() -> None:
    go, off = pose(1, 0, 3), pose(1.5, 2.5, -4)
    prior = GraspPrior(left_moved(go, off))
    for found in looked(BOX, go, prior):
        assert found.pose.status is PoseStatus.OK
        assert len(found.pose.unobserved) == 1
        along = np.array([-np.sin(go[2]), np.cos(go[2])])
        assert abs(found.pose.unobserved[0, :2] @ along) > 0.999
        # the prior's spread along it, and the prior's own place
        assert along @ found.pose.covariance[:2, :2] @ along == pytest.approx(0.003**2, rel=0.02)
        moved = left_difference(found.pose.pose, go)
        assert abs(moved[:2] @ (-along[1], along[0])) < 0.05 * MM
        assert abs(moved[:2] @ along) > 1.5 * MM
        assert abs(np.degrees(moved[2])) < 0.1


def test_one_side_alone_tells_its_distance_and_angle() -> None:
    square = Polygon(MM * np.array([(-60.0, -60), (60, -60), (60, 60), (-60, 60)]))
    go = pose(-55, 0, 0)  # its right side at x = 5 mm
    (found, _) = looked(square, go, GraspPrior(left_moved(go, pose(-2, 1, 3))))
    assert found.pose.status is PoseStatus.OK
    assert found.pose.unobserved.shape == (1, 3)
    assert abs(found.pose.unobserved[0, 1]) > 0.99
    x, _, angle = error(found.pose, go)
    assert abs(x) < 0.08
    assert abs(angle) < 0.15


def test_two_fingers_know_more_than_one() -> None:
    prior = GraspPrior(left_moved(END, pose(1, -2, 3)))
    each = [found.pose for found in looked(BOX, END, prior)]
    both = fuse(prior, each)
    assert np.linalg.det(both.covariance) < 0.3 * min(np.linalg.det(one.covariance) for one in each)
    x, y, angle = error(both, END)
    assert np.hypot(x, y) < 0.06
    assert abs(angle) < 0.1


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_shear_comes_with_the_pose(side: str) -> None:
    shear = pose(0.6, -0.5, 1.5)
    c, s = np.cos(shear[2]), np.sin(shear[2])
    go = np.array([*(np.array([[c, -s], [s, c]]) @ END[:2] + shear[:2]), shear[2]])
    (found,) = looked(BOX, go, GraspPrior(END), shear, sides=(side,))
    assert found.shear.known
    assert np.hypot(*left_difference(found.shear.pose, shear)[:2]) < 0.01 * MM
    assert abs(left_difference(found.shear.pose, shear)[2]) < np.radians(0.03)
    x, y, angle = error(found.pose, go)
    assert np.hypot(x, y) < 0.08
    assert abs(angle) < 0.15


def test_an_indentation_other_than_the_described_does_not_move_the_edges() -> None:
    """A face 0.3 mm nearer to the camera than said would lie 0.1 mm further out at 15 mm from the middle."""
    go = pose(0, -45, 0)
    (found,) = looked(BOX, go, GraspPrior(left_moved(go, pose(1, 1, 1))), sides=("left",), indentation_mm=0.5)
    assert found.shear.depth == pytest.approx(0.8e-3, abs=0.05e-3)
    x, y, angle = error(found.pose, go)
    assert np.hypot(x, y) < 0.05
    assert abs(angle) < 0.1


def test_slip_is_what_the_shear_does_not_explain() -> None:
    """First the gel carries the object along, then the object slides 0.4 mm down it."""
    shear = pose(0.5, -0.4, 1.0)
    c, s = np.cos(shear[2]), np.sin(shear[2])
    carried = np.array([*(np.array([[c, -s], [s, c]]) @ END[:2] + shear[:2]), shear[2]])
    prior = GraspPrior(END)
    before, stuck, slid = (
        looked(BOX, go, prior, by, sides=("left",), seed=k)[0]
        for k, (go, by) in enumerate(((END, pose()), (carried, shear), (carried + pose(0, -0.4, 0), shear)))
    )
    _, square = stuck.slip(before)
    assert square < 16.3  # χ² of three, once in a thousand
    delta, square = slid.slip(before)
    assert square > 30
    np.testing.assert_allclose(delta[:2], (0, -0.4 * MM), atol=0.06 * MM)


def test_the_papers_method_reads_gels_as_well() -> None:
    """Canny sees both sides of the wall beside the face, so it is millimetres off where this one is hundredths."""
    device = open_gelslim(GelHand(load_profile("lab"), BOX.vertices, END), "left")
    finger = FingerModel.of(device.describe().extra, device.reference())
    found = CannyIcp(finger, BOX, GelContact(finger).read).estimate(
        device.capture(), GraspPrior(left_moved(END, pose(1, -1, 2)))
    )
    assert found.status is PoseStatus.OK
    x, y, angle = error(found, END)
    assert np.hypot(x, y) < 3
    assert abs(angle) < 4


# -- what is no pose ---------------------------------------------------------------------------------------------------


def untouched(found: TactilePose, prior: GraspPrior) -> bool:
    """The pose is the prior's, and nothing is claimed of it."""
    same = np.array_equal(found.pose, prior.pose) and np.array_equal(found.covariance, prior.covariance)
    return same and not found.information.any() and len(found.unobserved) == 3 and bool(found.reason)


def test_a_face_beyond_the_view_shows_no_edge_but_its_shear() -> None:
    board = Polygon(MM * np.array([(-60.0, -60), (60, -60), (60, 60), (-60, 60)]))
    prior, shear = GraspPrior(pose(1, 1, 2)), pose(0.3, -0.2, 0.5)
    for found in looked(board, shear, prior, shear):
        assert found.pose.status is PoseStatus.NO_EDGE
        assert untouched(found.pose, prior)
        assert np.hypot(*left_difference(found.shear.pose, shear)[:2]) < 0.01 * MM


def test_an_outline_of_another_object_is_a_mismatch() -> None:
    prior = GraspPrior(END)
    others = (WEDGE, STRANGERS["hexagon"], Polygon(MM * np.array([(-20.0, -60), (20, -60), (20, 60), (-20, 60)])))
    for other in others:
        (found,) = looked(BOX, END, prior, believed=other, sides=("left",))
        assert found.pose.status in (PoseStatus.MISMATCH, PoseStatus.NO_EDGE)
        assert untouched(found.pose, prior)


@pytest.fixture(scope="module")
def finger() -> tuple[TactilePoseGel, ImageReading, ImageReading]:
    """A finger's estimator, a picture of the box and one of nothing."""
    hand = GelHand(load_profile("lab"), BOX.vertices, END)
    device = open_gelslim(hand, "left")
    estimator = TactilePoseGel(FingerModel.of(device.describe().extra, device.reference()), BOX)
    image = device.capture()
    hand.held = False
    empty = device.capture()
    return estimator, image, ImageReading(replace(empty.stamp, status=Status.OK), empty.image, "bgr8")


def test_nothing_in_the_fingers_is_no_contact(finger) -> None:
    estimator, _, empty = finger
    prior = GraspPrior(END)
    found = estimator.estimate(empty, prior)
    assert found.status is PoseStatus.NO_CONTACT
    assert untouched(found, prior)


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        (Status.NO_CONTACT, PoseStatus.NO_CONTACT),
        (Status.STALE, PoseStatus.UNTRUSTED),
        (Status.SATURATED, PoseStatus.SATURATED),
        (Status.INVALID, PoseStatus.UNTRUSTED),
    ],
)
def test_a_reading_that_is_not_to_be_trusted_is_not(finger, status: Status, expected: PoseStatus) -> None:
    estimator, image, _ = finger
    prior = GraspPrior(END)
    found = estimator.estimate(ImageReading(replace(image.stamp, status=status), image.image, "bgr8"), prior)
    assert found.status is expected
    assert untouched(found, prior)


@pytest.mark.parametrize(
    ("spoil", "expected"),
    [
        (np.zeros_like, PoseStatus.BLANK),
        (lambda image: np.minimum(image * 2.2, 255).astype(np.uint8), PoseStatus.SATURATED),
        (lambda image: np.concatenate((image[:100], np.zeros_like(image[100:]))), PoseStatus.TORN),
        (lambda image: np.roll(image, 100, axis=0), PoseStatus.TORN),
        (lambda image: image[:, :200], PoseStatus.UNTRUSTED),
    ],
    ids=["blank", "saturated", "half missing", "rolled", "cropped"],
)
def test_a_spoilt_picture_is_a_status(finger, spoil, expected: PoseStatus) -> None:
    estimator, image, _ = finger
    prior = GraspPrior(END)
    found = estimator.estimate(ImageReading(image.stamp, spoil(image.image), "bgr8"), prior)
    assert found.status is expected
    assert untouched(found, prior)


# -- figures -----------------------------------------------------------------------------------------------------------


def measured(grasps: list[Grasp], seed: int):
    """The benchmark's line of fused fingers for ``grasps``, each with a shear of its own."""
    family, rng, many = gelslim(), np.random.default_rng(seed), []
    for k, grasp in enumerate(grasps):
        shear = rng.standard_normal(3) * (3e-4, 3e-4, 0.01)
        each = [
            found.pose
            for found in looked(
                grasp.outline, grasp.X_ee_go, grasp.prior, shear, seed=seed + k, indentation=grasp.indentation
            )
        ]
        many.append(Estimate(grasp, fuse(grasp.prior, each), tuple(each), 0.0))
    return row("gel", many, family.shown)


def usable(grasp: Grasp) -> bool:
    """At least 8 mm of the boundary is in the fingers' view."""
    return len(gelslim().shown(grasp)[0]) * 0.5 > 8


def strange_grasps(count: int, seed: int) -> list[Grasp]:
    """Shapes that the catalogue does not have, held 5 to 14 mm inside of anywhere on the boundary, any way round."""
    rng, out, names = np.random.default_rng(seed), [], list(STRANGERS)
    while len(out) < count:
        outline = STRANGERS[names[len(out) % len(names)]]
        boundary = outline.boundary(1e-3)
        k = rng.integers(len(boundary.points))
        centre = boundary.points[k] - boundary.normals[k] * rng.uniform(4e-3, 14e-3)
        if outline.signed_distance(centre) > -3.5e-3:
            continue
        angle = rng.uniform(-np.pi, np.pi)
        c, s = np.cos(angle), np.sin(angle)
        go = np.array([*(-np.array([[c, -s], [s, c]]) @ centre), angle])
        off = rng.standard_normal(3) * (3e-3, 3e-3, np.radians(4.0))
        out.append(Grasp(outline, go, GraspPrior(left_moved(go, off)), float(rng.choice((0.6e-3, 0.8e-3, 1e-3)))))
    return out


def assert_figures(line) -> None:
    assert line.rms_mm < 0.3
    assert line.rms_deg < 0.5
    assert line.far <= 0.01
    assert line.flagged == 1.0
    assert 0.6 < line.nees_median < 1.7
    assert line.nees_mean < 2.0


def test_strange_shapes_are_found_as_well() -> None:
    line = measured(strange_grasps(8, 3), 3)
    assert line.far == 0
    assert line.rms_mm < 0.08
    assert line.rms_deg < 0.15
    assert line.flagged == 1.0


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_two_hundred_grasps_of_the_catalogue() -> None:
    grasps = [grasp for grasp in random_grasps(gelslim(), 210, 41, GRASPS) if usable(grasp)]
    assert len(grasps) >= 200
    assert_figures(measured(grasps, 41))


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_two_hundred_grasps_of_strange_shapes() -> None:
    assert_figures(measured([grasp for grasp in strange_grasps(200, 43) if usable(grasp)], 43))
