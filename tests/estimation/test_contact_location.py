"""Where the go is touched: exact wrenches to micrometres, noisy ones to what their covariance says, the plant's own."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import chi2

from drivers.scene import Body, Scene
from drivers.sim.plant import Plant
from estimation.contact_location import ContactLocator, ContactPrior, ContactStatus, Gates, observed_force
from estimation.contact_sites import Surface, faces_seen_by, ground_seen_by
from estimation.contact_wrench import EnvironmentWrench, from_force_torque
from estimation.force_torque import FreeAirLoad
from experiments.bench.contact import OUTLINES, accuracy, on_the_floor, touches
from mechanics import se2
from mechanics.catalogue import load_sensor
from mechanics.polygon import Polygon

from .contact_cases import MU, covariance, measured

BOX = OUTLINES["tall_box"]
HALF_WIDTH, HALF_HEIGHT = 0.025, 0.07345
#: faces of the box, as the catalogue lists its corners
BOTTOM, RIGHT = 0, 1
BOTTOM_LEFT, BOTTOM_RIGHT = 0, 1


def distances(found, points):
    return np.array([np.linalg.norm(e.hypotheses[0].point - p) for e, p in zip(found, points, strict=True)])


# -- accuracy ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", ["tall_box", "pentagon"])
def test_an_exact_wrench_is_located_to_micrometres_with_its_force(shape):
    true = touches(OUTLINES[shape], 200, np.random.default_rng(0))
    found = ContactLocator(OUTLINES[shape], MU).locate_each(measured(true.points, true.forces))
    assert distances(found, true.points).max() < 2e-6
    force = np.array([e.hypotheses[0].force for e in found])
    np.testing.assert_allclose(force, true.forces, atol=1e-4)


@pytest.mark.parametrize("shape", ["tall_box", "pentagon"])
def test_convex_shapes_at_three_newtons_with_the_wrist_sensors_noise(shape):
    row = accuracy(shape, 400, seed=1)
    assert row.median_mm <= 0.7 and row.p95_mm <= 2.0
    assert row.kept == 1.0 and row.told == 1.0


def test_a_tilted_corner_on_the_floor():
    row = on_the_floor("tall_box", 300, seed=1)
    assert row.median_mm <= 0.7 and row.p95_mm <= 2.0
    assert row.kept >= 0.97 and row.told >= 0.97


@pytest.mark.parametrize("shape", ["z", "L", "U"])
def test_shapes_with_dents_keep_the_true_face_and_a_prior_of_five_millimetres_picks_it(shape):
    blind = accuracy(shape, 300, seed=2)
    assert blind.kept >= 0.99
    assert blind.misled < 5.0  # what is told is true; the rest is said to be ambiguous
    believed = accuracy(shape, 300, prior=0.005, seed=2)
    assert believed.kept >= 0.99 and believed.told >= 0.99
    assert believed.p95_mm <= 2.0


def test_the_deviation_along_the_face_is_honest():
    rng = np.random.default_rng(3)
    true = touches(BOX, 500, rng)
    # away from the corners, where the end of the face cuts the errors off
    inner = np.linalg.norm(BOX.vertices[:, None] - true.points, axis=-1).min(axis=0) > 0.005
    found = ContactLocator(BOX, MU).locate_each(measured(true.points, true.forces, rng))
    deviation = np.array([e.hypotheses[0].deviation for e in found])[inner]
    squared = (distances(found, true.points)[inner] / deviation) ** 2
    assert 0.6 < np.median(squared) / chi2(1).median() < 1.7
    assert np.mean(squared) < 2
    best = found[int(np.flatnonzero(inner)[0])].hypotheses[0]
    np.testing.assert_allclose(best.covariance, best.deviation**2 * np.outer(best.along, best.along))


def test_a_prior_weighs_against_the_wrench_by_their_variances():
    point = np.array([0.0, -HALF_HEIGHT])
    blind = ContactLocator(BOX, MU).locate(measured(point, [0.0, 3.0])).hypotheses[0]
    prior = ContactPrior(point + np.array([0.004, 0.0]), 0.002)
    best = ContactLocator(BOX, MU).locate(measured(point, [0.0, 3.0]), prior=prior).hypotheses[0]
    share = 0.002**-2 / (0.002**-2 + blind.deviation**-2)
    assert best.point == pytest.approx(point + share * np.array([0.004, 0.0]), abs=1e-6)
    assert best.deviation == pytest.approx((0.002**-2 + blind.deviation**-2) ** -0.5, rel=1e-4)


# -- whose cone ----------------------------------------------------------------------------------------------------


def on_a_corner(tilt: float, lean: float):
    """The box tilted by ``tilt`` on its lower corner; the floor's force leans by ``lean`` from the vertical."""
    vertex = BOTTOM_RIGHT if tilt < 0 else BOTTOM_LEFT
    heights = BOX.transformed((0.0, 0.0, tilt)).vertices[:, 1]
    assert heights.argmin() == vertex
    force = se2.rotate(-tilt, 3 * np.array([np.sin(lean), np.cos(lean)]))
    return vertex, np.array([0.1, -heights.min(), tilt]), force


@pytest.mark.parametrize("tilt", [-0.7, 0.7])
def test_at_a_vertex_the_floors_cone_holds_where_neither_face_has_the_force(tilt):
    vertex, pose, force = on_a_corner(tilt, 0.0)
    own = -BOX.normals[[vertex - 1, vertex]] @ force / 3
    assert (own < np.cos(np.arctan(MU))).all()  # outside both faces' cones
    found = ContactLocator(BOX, MU).locate(measured(BOX.vertices[vertex], force), [ground_seen_by(pose)])
    assert found.status is ContactStatus.OK and found.contact is not None
    assert found.contact.vertex == vertex and found.contact.face is None
    assert found.contact.chi2 < 1e-6 and found.contact.deviation == 0.0
    assert found.contact.force == pytest.approx(force, abs=1e-6)


def test_beyond_the_floors_cone_nothing_is_explained_though_the_open_fan_would_take_it():
    _, pose, force = on_a_corner(-0.7, -np.arctan(MU) - 0.2)
    wrench = measured(BOX.vertices[BOTTOM_RIGHT], force)
    found = ContactLocator(BOX, MU).locate(wrench, [ground_seen_by(pose)])
    assert found.status is ContactStatus.UNEXPLAINED and found.contact is None and not found.hypotheses
    assert "χ²" in found.reason
    unknown = ContactLocator(BOX, MU).locate(wrench)
    assert unknown.contact is not None and unknown.contact.vertex == BOTTOM_RIGHT


def test_the_friction_of_the_pair_is_the_surfaces_own():
    _, pose, force = on_a_corner(-0.7, -np.arctan(MU) - 0.2)
    rough = ground_seen_by(pose, mu=0.8)
    found = ContactLocator(BOX, MU).locate(measured(BOX.vertices[BOTTOM_RIGHT], force), [rough])
    assert found.contact is not None and found.contact.vertex == BOTTOM_RIGHT


def test_a_surface_behind_the_object_is_not_the_one_that_touches_a_vertex():
    # an upright wall whose outward normal points away from the go's right side cannot touch its bottom right corner
    wall = Surface(np.array([HALF_WIDTH + 0.001, -HALF_HEIGHT]), np.array([1.0, 0.0]), 0.05)
    locator = ContactLocator(BOX, MU)
    with_wall, without = locator.sites([wall]), locator.sites()
    np.testing.assert_array_equal(with_wall.rays, without.rays)


def test_a_known_scene_leaves_only_what_it_can_reach():
    locator = ContactLocator(BOX, MU, only_near=True)
    corner = Polygon([[0.0, 0.0], [0.1, -0.05], [0.1, 0.05]])  # points at the right face, 3 mm from it, 20 mm up
    surroundings = faces_seen_by(np.array([HALF_WIDTH + 0.003, 0.02, 0.0]), corner)
    where = locator.sites(surroundings)
    assert set(where.group.tolist()) == {RIGHT}
    assert where.offset[0] == pytest.approx(HALF_HEIGHT + 0.02 - 0.01) and where.length[0] == pytest.approx(0.02)
    found = locator.locate(measured([HALF_WIDTH, 0.022], [-3.0, 0.4]), surroundings)
    assert found.contact is not None
    assert found.contact.point == pytest.approx([HALF_WIDTH, 0.022], abs=2e-6)
    elsewhere = locator.locate(measured([0.0, -HALF_HEIGHT], [0.0, 3.0]), surroundings)
    assert elsewhere.status is ContactStatus.UNEXPLAINED


def test_flat_on_the_floor_the_whole_face_can_carry_the_force():
    flat = ContactLocator(BOX, MU, only_near=True)
    found = flat.locate(
        measured([0.012, -HALF_HEIGHT], [0.0, 3.0]), [ground_seen_by(np.array([0.3, HALF_HEIGHT, 0.0]))]
    )
    assert found.contact is not None and found.contact.face == BOTTOM
    assert found.contact.point == pytest.approx([0.012, -HALF_HEIGHT], abs=2e-6)


def test_far_from_everything_a_force_is_out_of_reach():
    locator = ContactLocator(BOX, MU, only_near=True)
    found = locator.locate(measured([0.0, -HALF_HEIGHT], [0.0, 3.0]), [ground_seen_by(np.array([0.0, 0.3, 0.0]))])
    assert found.status is ContactStatus.OUT_OF_REACH and found.contact is None
    assert "10 mm" in found.reason


# -- the plant's own contacts --------------------------------------------------------------------------------------


def located(plant: Plant, surroundings) -> tuple:
    """The one contact on the go as the plant has it, in go, and what the locator makes of the fingers' wrench."""
    (truth,) = [c for c in plant.contacts() if "go" in (c.on, c.by)]
    force = truth.force if truth.on == "go" else -truth.force
    p_W = np.array([0.05, 0.4])  # about any point
    load = FreeAirLoad(plant.scene.grasped.mass, np.zeros(2), plant.scene.gravity)
    wrench = from_force_torque(plant.coupling_wrench(p_W), covariance(), plant.go, p_W, load)
    found = ContactLocator(BOX, MU + 0.01).locate(wrench, surroundings(plant))
    point = se2.transform(se2.inverse(plant.go), truth.point)
    return found, point, se2.rotate(-plant.go[2], force)


def press(plant: Plant, motion, seconds: float = 1.0) -> None:
    steps = round(seconds / plant.timestep)
    start = np.array(plant.ee_pose)
    for i in range(steps + 300):
        share = min(1.0, (i + 1) / steps)
        plant.step(tuple((start + share * np.asarray(motion)).tolist()), (0.0, 0.0, 0.0))


def scene(**parts) -> Scene:
    stiffness = tuple(tuple(row) for row in load_sensor("soft_bubble").stiffness.tolist())
    grasped = Body(name="tall_box", vertices=tuple(map(tuple, BOX.vertices.tolist())), mass=0.1)
    friction = {"go-ground": MU, "go-eo": MU, "eo-ground": MU}
    usual = {"grasped": grasped, "grasp": (0.0, 0.045, 0.0), "stiffness": stiffness, "friction": friction}
    return Scene(**(usual | parts))


@pytest.mark.parametrize("tilt", [-0.4, 0.25])
def test_the_plants_corner_on_the_ground_is_found_from_the_fingers_wrench(tilt):
    heights = BOX.transformed((0.0, 0.0, tilt)).vertices[:, 1]
    grasp = se2.rotate(tilt, np.array([0.0, 0.045]))
    plant = Plant(scene(start=(0.1 + grasp[0], grasp[1] - heights.min() + 0.002, tilt)))
    press(plant, (0.0, -0.004, 0.0))
    found, point, force = located(plant, lambda plant: [ground_seen_by(plant.go)])
    assert np.linalg.norm(force) > 1.5
    assert found.contact is not None and heights.argmin() in [h.vertex for h in found.hypotheses]
    assert found.contact.point == pytest.approx(point, abs=1e-4)
    assert found.contact.force == pytest.approx(force, abs=0.02)


def test_the_plants_corner_of_another_object_against_a_face_is_found():
    block = Body(name="hbox", vertices=((-0.06, -0.03), (0.06, -0.03), (0.06, 0.03), (-0.06, 0.03)), mass=0.5)
    tilt = -0.35  # leans over the block's upper left corner
    corner = np.array([0.24, 0.06])
    along = se2.rotate(tilt, np.array([0.0, 1.0]))
    centre = corner - 0.025 * se2.rotate(tilt, np.array([1.0, 0.0])) + 0.02 * along - np.array([0.002, 0.0])
    grasp = centre + 0.045 * along
    plant = Plant(scene(extrinsic=block, extrinsic_pose=(0.3, 0.03, 0.0), start=(*grasp.tolist(), tilt)))
    plant.clamp("eo")
    press(plant, (0.007, 0.0, 0.0))
    outline = Polygon(block.vertices)
    found, point, force = located(
        plant, lambda plant: faces_seen_by(se2.compose(se2.inverse(plant.go), plant.eo), outline)
    )
    assert np.linalg.norm(force) > 1.5
    assert found.contact is not None and found.contact.face == RIGHT
    assert found.contact.point == pytest.approx(point, abs=1e-4)
    assert found.contact.force == pytest.approx(force, abs=0.02)


# -- what cannot be answered ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("wrench", [[0.0, 0.0, 0.0], [0.3, 0.4, 0.02], [0.0, 0.0, 0.3]])
def test_no_force_is_no_contact(wrench):
    found = ContactLocator(BOX, MU).locate(EnvironmentWrench.of(wrench, covariance()))
    assert found.status is ContactStatus.NO_WRENCH and not found.hypotheses
    assert "1 N is needed" in found.reason


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_what_is_no_number_is_said_to_be_invalid(bad):
    locator = ContactLocator(BOX, MU)
    found = locator.locate(EnvironmentWrench(np.array([0.0, bad, 0.0]), np.eye(3), np.zeros(2)))
    assert found.status is ContactStatus.INVALID and not found.hypotheses
    H = np.eye(3)
    H[0, 0] = bad
    assert locator.locate(EnvironmentWrench(np.zeros(3), H, np.zeros(2))).status is ContactStatus.INVALID


def test_one_bad_wrench_of_a_batch_spoils_no_other():
    wrenches = measured(np.tile([0.01, -HALF_HEIGHT], (3, 1)), np.tile([0.0, 3.0], (3, 1)))
    wrenches.wrench[1, 2] = np.nan
    found = ContactLocator(BOX, MU).locate_each(wrenches)
    assert [e.status.value for e in found] == ["ok", "invalid", "ok"]
    alone = ContactLocator(BOX, MU).locate(measured([0.01, -HALF_HEIGHT], [0.0, 3.0])).hypotheses[0]
    np.testing.assert_array_equal(found[2].hypotheses[0].point, alone.point)


def test_a_wrench_whose_line_passes_the_object_by_is_unexplained():
    found = ContactLocator(BOX, MU).locate(measured([0.06, 0.0], [0.0, 3.0]))
    assert found.status is ContactStatus.UNEXPLAINED and not found.hypotheses


def test_two_prongs_of_a_u_explain_the_same_push_and_both_are_kept():
    u = OUTLINES["U"]
    left = u.vertices[:, 0].min()
    found = ContactLocator(u, MU).locate(measured([left, 0.03], [3.0, 0.0]))
    assert found.status is ContactStatus.AMBIGUOUS and found.contact is None
    assert sorted(h.point[0] for h in found.hypotheses) == pytest.approx([left, left + 0.07])
    assert [h.weight for h in found.hypotheses] == pytest.approx([0.5, 0.5], abs=1e-3)
    assert "both explain" in found.reason


def test_without_the_torque_the_place_on_the_face_is_said_to_be_open():
    information = np.diag([1e5, 1e5, 0.0])
    found = ContactLocator(BOX, MU).locate(EnvironmentWrench(np.array([0.0, 3.0, 0.7]), information, np.zeros(2)))
    assert found.status is ContactStatus.AMBIGUOUS
    best = next(h for h in found.hypotheses if h.face == BOTTOM)
    assert best.deviation == pytest.approx(2 * HALF_WIDTH / np.sqrt(12))


def test_force_is_observed_only_where_it_is_known():
    wrench = np.array([3.0, 0.5, 0.0])
    assert observed_force(wrench, np.diag([400.0, 400.0, 1e5]), 1.0) == pytest.approx(np.hypot(3.0, 0.5))
    assert observed_force(wrench, np.diag([0.0, 400.0, 1e5]), 1.0) == pytest.approx(0.5)
    # a sum of force and torque says nothing of the force alone
    mixed = np.array([1.0, 0.0, 10.0])
    assert observed_force(wrench, 1e4 * np.outer(mixed, mixed), 1.0) == pytest.approx(0.0, abs=1e-6)


def test_the_point_about_which_the_wrench_is_given_changes_nothing():
    wrench = measured([0.01, -HALF_HEIGHT], [0.5, 3.0], np.random.default_rng(0))
    locator = ContactLocator(BOX, MU)
    here, there = locator.locate(wrench).hypotheses[0], locator.locate(wrench.moved_to((0.3, -0.2))).hypotheses[0]
    assert there.point == pytest.approx(here.point, abs=1e-6)
    assert there.deviation == pytest.approx(here.deviation, rel=1e-6)
    assert there.chi2 == pytest.approx(here.chi2, abs=1e-6)


@pytest.mark.parametrize("figures", [{"mu": -0.1}, {"mu": np.nan}, {"spacing": 0.0}, {"near": np.inf}])
def test_a_locator_refuses_figures_that_mean_nothing(figures):
    with pytest.raises(ValueError, match=next(iter(figures))):
        ContactLocator(BOX, **({"mu": MU} | figures))


def test_the_gates_are_the_callers():
    locator = ContactLocator(BOX, MU, gates=Gates(force=4.0))
    assert locator.locate(measured([0.0, -HALF_HEIGHT], [0.0, 3.0])).status is ContactStatus.NO_WRENCH
