"""One state from readings that come at their own rates, late and out of order, checked against a world made of K."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from scipy.stats import chi2

from estimation.contact_filter import ContactFilter
from estimation.contact_location import ContactLocator, ContactStatus
from estimation.contact_tracking import ContactTracker
from estimation.contact_wrench import EnvironmentWrench
from estimation.force_torque import FreeAirLoad, WristSensor
from estimation.grasp_filter import GraspFilter
from estimation.state import NoState, StateEstimator
from estimation.tactile_pose import PoseStatus, TactilePose
from estimation.tag_pose import TagPose
from mechanics import se2
from mechanics.catalogue import load_object, load_sensor
from mechanics.elasticity import Elasticity
from mechanics.polygon import Polygon
from mechanics.readings import Array, PoseReading, Stamp, Status, WrenchReading
from mechanics.task_plane import TaskPlane

GRASP = np.array([0.0, 0.045, 0.0])
BOX = load_object("tall_box")
LOAD = FreeAirLoad(BOX.mass, np.zeros(2))
K = load_sensor("soft_bubble").stiffness
WRIST = WristSensor(np.array([0.0, 0.2, 0.0]), np.zeros(3))
MS = 1_000_000


def estimator(**changes: object) -> StateEstimator:
    made = StateEstimator(GraspFilter(GRASP), Elasticity(K), WRIST, LOAD)
    return replace(made, **changes) if changes else made  # type: ignore[arg-type]


class Held:
    """A go held by springs of K, with its grasp off by ``q``; all that a perfect sensor would say of it."""

    def __init__(self, q: tuple[float, float, float] = (0.0, 0.0, 0.0)):
        self.q = np.array(q)

    def go(self, ee: Array, w_gocf: Array) -> Array:
        x = np.linalg.solve(K, w_gocf)
        return se2.compose(se2.compose(se2.compose(ee, se2.inverse(x)), self.q), se2.inverse(GRASP))

    def wrist(self, at: int, ee: Array, w_gocf: Array) -> WrenchReading:
        X_W_gocf = se2.compose(ee, se2.inverse(np.linalg.solve(K, w_gocf)))
        c, s = np.cos(X_W_gocf[2]), np.sin(X_W_gocf[2])
        w = np.array([c * w_gocf[0] - s * w_gocf[1], s * w_gocf[0] + c * w_gocf[1], w_gocf[2]])
        planar = WRIST.reading_of(w, ee, X_W_gocf[:2])
        return WrenchReading(stamp(at, "wrist"), TaskPlane().wrench_to_spatial(planar))


def stamp(at: int, frame: str, status: Status = Status.OK) -> Stamp:
    return Stamp(at, at, at // MS, frame, status)


def pose(at: int, ee: Array) -> PoseReading:
    return PoseReading(stamp(at, "W"), ee)


def tactile(go_in_ee: Array, information: Array, prior_pose: Array, prior_covariance: Array) -> TactilePose:
    """What a finger of this information answers that sees the truth: the posterior under its prior."""
    delta = se2.compose(go_in_ee, se2.inverse(prior_pose))
    precision = np.linalg.inv(prior_covariance) + information
    posterior = np.linalg.solve(precision, information @ delta)
    return TactilePose(
        se2.compose(posterior, prior_pose),
        np.asarray(np.linalg.inv(precision), np.float64),
        information,
        np.empty((0, 3)),
        PoseStatus.OK,
    )


def feed(made: StateEstimator, held: Held, at: int, ee: Array, w: Array) -> None:
    for i in range(101):  # the wrist at 1 kHz, the arm at 100 Hz
        if i % 10 == 0:
            made.push_pose(pose(at - (100 - i) * MS, ee))
        made.push_wrench(held.wrist(at - (100 - i) * MS, ee, w))


def look(made: StateEstimator, held: Held, at: int, ee: Array, w: Array, information: Array) -> None:
    prior = made.expected(at)
    seen = se2.between(ee, held.go(ee, w))
    made.push_tactile(at, prior, tactile(seen, information, prior.pose, prior.covariance))


GOOD = np.diag(np.array([1e-4, 1e-4, np.radians(0.2)]) ** -2)
EE = np.array([0.1, 0.15, 0.2])
LOADED = np.array([2.0, 4.0, 0.08])


def test_without_an_image_the_object_moves_in_the_fingers_by_their_elasticity() -> None:
    made, held = estimator(), Held()
    feed(made, held, 200 * MS, EE, LOADED)
    np.testing.assert_allclose(made.state().go, held.go(EE, LOADED), atol=1e-6)


def test_the_wrench_is_of_the_sensor_on_the_go_about_the_grasp_centre() -> None:
    made, held = estimator(), Held()
    feed(made, held, 200 * MS, EE, LOADED)
    X_W_gocf = se2.compose(held.go(EE, LOADED), GRASP)
    c, s = np.cos(X_W_gocf[2]), np.sin(X_W_gocf[2])
    turned = [c * LOADED[0] - s * LOADED[1], s * LOADED[0] + c * LOADED[1], LOADED[2]]
    np.testing.assert_allclose(made.state().wrench, turned, atol=2e-4)


def test_the_wrench_is_about_the_fingers_however_the_object_lies_in_them() -> None:
    made, held = estimator(), Held((0.003, -0.002, 0.0))
    feed(made, held, 200 * MS, EE, LOADED)
    for at in (150, 180, 200):
        look(made, held, at * MS, EE, LOADED, GOOD)
    state = made.state()
    assert state.wrench[2] == pytest.approx(LOADED[2], abs=1e-4)
    assert state.centre == pytest.approx(se2.compose(EE, se2.inverse(np.linalg.solve(K, LOADED)))[:2], abs=1e-6)
    # and that is not the grasp centre on the object, as planned: 3.6 mm away
    assert np.hypot(*(se2.compose(state.go, GRASP)[:2] - state.centre)) == pytest.approx(np.hypot(3e-3, 2e-3), rel=0.02)


def test_a_tag_newer_than_every_other_reading_is_part_of_the_state() -> None:
    made, held = estimator(), Held((0.002, 0.001, -0.03))
    feed(made, held, 200 * MS, EE, LOADED)
    truth = held.go(EE, LOADED)
    made.push_tag("go", 204 * MS, TagPose(truth, np.eye(3) * 1e-12, 0.0, 1))
    np.testing.assert_allclose(made.state().go, truth, atol=1e-4)


def test_images_find_a_grasp_that_is_off_and_it_stays_found_under_another_wrench() -> None:
    made, held = estimator(), Held((0.0015, -0.001, 0.03))
    feed(made, held, 200 * MS, EE, np.zeros(3))
    for at in (150, 180, 200):
        look(made, held, at * MS, EE, np.zeros(3), GOOD)
    feed(made, held, 500 * MS, EE, LOADED)
    error = se2.between(held.go(EE, LOADED), made.state().go)
    assert np.hypot(*error[:2]) < 5e-5 and abs(error[2]) < 5e-4


def test_a_picture_newer_than_every_other_reading_is_part_of_the_state() -> None:
    made, held = estimator(), Held((0.0015, -0.001, 0.03))
    feed(made, held, 200 * MS, EE, np.zeros(3))
    look(made, held, 210 * MS, EE, np.zeros(3), GOOD)
    error = se2.between(held.go(EE, np.zeros(3)), made.state().go)
    assert np.hypot(*error[:2]) < 5e-5 and abs(error[2]) < 5e-4


def test_what_images_leave_open_stays_at_the_prior_with_the_priors_variance() -> None:
    made, held = estimator(), Held((0.001, 0.002, 0.0))
    blind_in_y = GOOD * np.diag([1.0, 0.0, 1.0])
    feed(made, held, 200 * MS, EE, np.zeros(3))
    for at in (160, 180, 200):
        look(made, held, at * MS, EE, np.zeros(3), blind_in_y)
    belief = made.expected(200 * MS)
    off = se2.compose(belief.pose, GRASP)
    assert off[0] == pytest.approx(0.001, abs=2e-5)
    assert off[1] == pytest.approx(0.0, abs=1e-4)
    assert np.sqrt(belief.covariance[1, 1]) == pytest.approx(0.003, rel=0.05)


def test_the_state_does_not_hang_on_the_order_in_which_readings_arrive() -> None:
    held = Held((0.001, -0.001, 0.02))
    frames = [(120, np.zeros(3)), (160, 0.5 * LOADED), (200, LOADED)]
    prior = estimator()
    feed(prior, held, 200 * MS, EE, LOADED)
    answers = []
    for order in permutations(range(3)):
        made = estimator(window=0.002)
        for i in range(101):
            at = (100 + i) * MS
            w = frames[min(2, max(0, (i - 10) // 40))][1]
            made.push_pose(pose(at, EE))
            made.push_wrench(held.wrist(at, EE, w))
        for k in order:
            at, w = frames[k][0] * MS, frames[k][1]
            seen = se2.between(EE, held.go(EE, w))
            fixed = made.expected(0)  # the same prior in every order
            made.push_tactile(at, fixed, tactile(seen, GOOD, fixed.pose, fixed.covariance))
        answers.append(made.state(200 * MS).go)
    np.testing.assert_allclose(answers, np.tile(answers[0], (6, 1)), atol=1e-9)


def test_a_known_delay_is_taken_off_before_a_reading_finds_its_place() -> None:
    made, held = estimator(delays={"tactile": 0.05}, window=0.002), Held()
    for i in range(201):
        made.push_pose(pose(i * MS, EE))
        made.push_wrench(held.wrist(i * MS, EE, LOADED * (i >= 120)))
    unloaded, loaded = made.expected(160 * MS), made.expected(180 * MS)  # measured at 110 ms and at 130 ms
    np.testing.assert_allclose(unloaded.pose, se2.between(EE, held.go(EE, np.zeros(3))), atol=1e-6)
    np.testing.assert_allclose(loaded.pose, se2.between(EE, held.go(EE, LOADED)), atol=1e-6)


def test_an_object_that_slips_in_the_fingers_is_said_to_and_is_followed() -> None:
    made, held = estimator(), Held()
    feed(made, held, 200 * MS, EE, np.zeros(3))
    for at in (120, 140, 160, 180):
        look(made, held, at * MS, EE, np.zeros(3), GOOD)
    assert made.state().status is PoseStatus.OK
    slipped = Held((0.0, 0.004, 0.0))
    feed(made, slipped, 400 * MS, EE, np.zeros(3))
    for at in (340, 360, 380, 400):
        look(made, slipped, at * MS, EE, np.zeros(3), GOOD)
    state = made.state()
    assert state.status is PoseStatus.SLIPPED and "slipped" in state.reason
    assert np.hypot(*se2.between(slipped.go(EE, np.zeros(3)), state.go)[:2]) < 1e-4


def test_the_covariance_is_that_of_the_errors_over_many_grasps() -> None:
    rng = np.random.default_rng(3)
    ratios = []
    for _ in range(200):
        made = estimator()
        scale = np.array(made.grasp.noise.prior)
        q = scale * rng.standard_normal(3)
        held = Held(tuple(q))
        made.push_pose(pose(200 * MS, EE))
        made.push_wrench(held.wrist(200 * MS, EE, np.zeros(3)))
        information = np.diag(np.array([3e-4, 1e-3, np.radians(0.5)]) ** -2)
        at, prior = 200 * MS, made.expected(200 * MS)
        noisy = se2.compose(
            rng.multivariate_normal(np.zeros(3), np.linalg.inv(information)), se2.between(EE, held.go(EE, np.zeros(3)))
        )
        made.push_tactile(at, prior, tactile(noisy, information, prior.pose, prior.covariance))
        belief = made.expected(at)
        delta = se2.compose(se2.between(EE, held.go(EE, np.zeros(3))), se2.inverse(belief.pose))
        ratios.append(delta @ np.linalg.solve(belief.covariance, delta))
    assert np.median(ratios) / chi2.median(3) == pytest.approx(1.0, abs=0.3)


def test_tags_serve_as_a_source_of_the_objects_pose() -> None:
    made, held = estimator(), Held((0.002, 0.001, -0.03))
    feed(made, held, 200 * MS, EE, LOADED)
    truth = held.go(EE, LOADED)
    made.push_tag("go", 200 * MS, TagPose(truth, np.eye(3) * 1e-12, 0.0, 1))
    made.push_tag("eo", 190 * MS, TagPose(np.array([0.2, 0.1, 0.0]), np.eye(3) * 1e-12, 0.0, 1))
    state = made.state()
    np.testing.assert_allclose(state.go, truth, atol=1e-4)  # the prior pulls by a thousandth
    assert state.eo is not None and state.ages["eo tag"] == pytest.approx(0.01)


def tracker(**changes: object) -> ContactTracker:
    locator = ContactLocator(BOX.polygon, 0.5, only_near=True)
    made = ContactTracker(ContactFilter(locator, np.random.default_rng(0)), {})
    return replace(made, **changes) if changes else made  # type: ignore[arg-type]


def on_a_corner(
    made: StateEstimator, at: int, tilt: float, force: Array, corner: Array, held: Held | None = None
) -> None:
    """Readings until ``at`` of the box standing on its ``corner`` at the origin of W, where ``force`` acts on it."""
    held = held or Held()
    X_W_go = np.array([0.0, 0.0, tilt])
    X_W_go[:2] -= se2.transform(X_W_go, corner)
    fingers = se2.compose(se2.compose(X_W_go, GRASP), se2.inverse(held.q))
    lever = -fingers[:2]
    environment = np.array([*force, lever[0] * force[1] - lever[1] * force[0]])
    w_W = LOAD.wrench_on_go(X_W_go, fingers[:2]) - environment
    c, s = np.cos(fingers[2]), np.sin(fingers[2])
    w = np.array([c * w_W[0] + s * w_W[1], -s * w_W[0] + c * w_W[1], w_W[2]])
    ee = se2.compose(fingers, np.linalg.solve(K, w))
    feed(made, held, at, ee, w)
    for before in (60, 30, 0):
        look(made, held, at - before * MS, ee, w, 100 * GOOD)


def test_the_corner_that_presses_on_the_ground_is_located_while_the_box_turns_on_it() -> None:
    made, force = estimator(contact=tracker()), np.array([0.3, 3.0])
    corner = BOX.polygon.vertices[BOX.polygon.lowest_vertices(0.3)[0]]
    for at, tilt in ((200, 0.3), (900, 0.35), (1600, 0.4)):
        on_a_corner(made, at * MS, tilt, force, corner)
        contact = made.state().contact
        assert contact is not None and contact.status is ContactStatus.OK and contact.contact is not None
        np.testing.assert_allclose(contact.contact.point, corner, atol=1e-4)
        assert np.hypot(*contact.contact.force) == pytest.approx(np.hypot(*force), rel=0.02)


def test_an_object_that_lies_off_in_the_fingers_is_touched_where_it_is() -> None:
    made, force = estimator(contact=tracker()), np.array([0.3, 3.0])
    corner = BOX.polygon.vertices[BOX.polygon.lowest_vertices(0.3)[0]]
    on_a_corner(made, 200 * MS, 0.3, force, corner, Held((0.003, -0.003, 0.02)))
    contact = made.state().contact
    assert contact is not None and contact.contact is not None
    np.testing.assert_allclose(contact.contact.point, corner, atol=1e-4)
    assert contact.contact.chi2 < 1.0


def test_asking_twice_or_for_the_past_leaves_the_contact_as_it_is_followed() -> None:
    made = estimator(contact=tracker())
    corner = BOX.polygon.vertices[BOX.polygon.lowest_vertices(0.3)[0]]
    on_a_corner(made, 200 * MS, 0.3, np.array([0.3, 3.0]), corner)
    now = made.state().contact
    assert made.state().contact is now
    before = made.state(150 * MS).contact
    assert before is not None and before is not now and before.contact is not None
    np.testing.assert_allclose(before.contact.point, corner, atol=1e-4)
    assert made.state().contact is now


UP_IN_THE_AIR = np.array([0.0, 0.3, 0.0])
SQUARE = Polygon(np.array([[-0.05, -0.05], [0.05, -0.05], [0.05, 0.05], [-0.05, 0.05]]))


def pushed_from_the_right(height: float) -> tuple[Array, EnvironmentWrench]:
    """A square that stands on its corner pushes with it at the box's right side: its pose in W, what the box feels."""
    half = float(BOX.polygon.vertices[:, 0].max())
    eo = np.array([half + 0.05 * np.sqrt(2), UP_IN_THE_AIR[1] + height, np.pi / 4])
    force = np.array([-3.0, 0.4])
    torque = half * force[1] - height * force[0]
    return eo, EnvironmentWrench.of([*force, torque], np.diag([0.02, 0.02, 0.0006]) ** 2)


@pytest.mark.parametrize("height", [-0.05, -0.02])
def test_a_corner_of_the_extrinsic_object_on_a_face_is_located(height: float) -> None:
    eo, felt = pushed_from_the_right(height)
    made = tracker(eo_outline=SQUARE)
    for i in range(4):
        made.at(i * 500 * MS, UP_IN_THE_AIR, np.zeros((3, 3)), eo, felt)
    found = made.at(2000 * MS, UP_IN_THE_AIR, np.zeros((3, 3)), eo, felt)
    assert found.status is ContactStatus.OK and found.contact is not None
    np.testing.assert_allclose(found.contact.point, [BOX.polygon.vertices[:, 0].max(), height], atol=1e-3)


def test_a_push_where_nothing_was_seen_is_out_of_reach() -> None:
    _, felt = pushed_from_the_right(-0.02)
    found = tracker(eo_outline=SQUARE).at(0, UP_IN_THE_AIR, np.zeros((3, 3)), None, felt)
    assert found.status is ContactStatus.OUT_OF_REACH


def test_what_is_not_known_of_the_objects_pose_is_not_known_of_the_contact() -> None:
    # the force acts across the face: an error of 2 mm along the face is one of 2 mm in where on it
    eo, felt = pushed_from_the_right(-0.02)
    pose = np.diag(np.array([0.002, 0.002, 1e-5]) ** 2)
    found = tracker(eo_outline=SQUARE).at(0, UP_IN_THE_AIR, pose, eo, felt)
    assert found.contact is not None and found.contact.deviation == pytest.approx(0.002, rel=0.1)


def test_before_a_source_has_spoken_there_is_no_state_and_it_is_named() -> None:
    made = estimator()
    with pytest.raises(NoState, match="the arm"):
        made.state()
    made.push_pose(pose(MS, EE))
    with pytest.raises(NoState, match="wrist"):
        made.state()


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_readings_that_are_no_numbers_are_left_out(bad: float) -> None:
    made, held = estimator(), Held()
    feed(made, held, 200 * MS, EE, LOADED)
    good = made.state().go
    made.push_wrench(WrenchReading(stamp(201 * MS, "wrist"), np.full(6, bad)))
    made.push_pose(pose(202 * MS, np.full(3, bad)))
    made.push_wrench(replace(held.wrist(203 * MS, EE, 5 * LOADED), stamp=stamp(203 * MS, "wrist", Status.SATURATED)))
    np.testing.assert_allclose(made.state().go, good, atol=1e-9)


def test_an_image_that_says_nothing_leaves_the_belief_and_its_reason_shows() -> None:
    made, held = estimator(), Held()
    feed(made, held, 200 * MS, EE, LOADED)
    prior = made.expected(200 * MS)
    made.push_tactile(200 * MS, prior, TactilePose.unknown(prior, PoseStatus.NO_EDGE, "the face fills the view"))
    state = made.state()
    assert state.status is PoseStatus.NO_EDGE and "fills the view" in state.reason
    np.testing.assert_allclose(state.go, held.go(EE, LOADED), atol=1e-6)
