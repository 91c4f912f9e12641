"""The error figures against hand-computed values and the paper's own arithmetic."""

import numpy as np
import pytest

from estimation.tool_identification import Agreement
from experiments import metrics
from experiments.metrics import contact_of, paper_summary, pose_errors, witness_of
from mechanics.friction import Mode
from mechanics.polygon import Polygon
from mechanics.records import ContactBelief, PlanarState, WaypointRecord
from planning.plan import Plan


def waypoint(go, wrench, truth=None, eo=None):
    planned = PlanarState(np.zeros(3), np.zeros(3), None if eo is None else np.zeros(3), np.zeros(3))
    measured = PlanarState(np.zeros(3), None if go is None else np.array(go), eo, np.array(wrench))
    return WaypointRecord(0, "t", 0, planned, np.zeros(3), measured, truth)


def errors_of(*arguments) -> dict:
    figures = metrics.errors_of(*arguments)
    assert figures is not None
    return figures


def test_one_waypoint_gives_the_norm_with_the_radius_of_gyration():
    figures = errors_of([waypoint([3e-3, 0.0, 0.1], [0.3, 0.4, 0.012])], "measured", 0.04, None, 0.01)
    assert figures["go_pose_mm"]["mean"] == pytest.approx(5.0)  # 3 mm and 40 mm × 0.1 rad
    assert figures["wrench_N"]["mean"] == pytest.approx(1.3)  # 0.3, 0.4 and 0.012 / 0.01 N
    assert figures["tau_Nmm"]["mean"] == pytest.approx(12.0)
    assert figures["theta_deg"]["mean"] == pytest.approx(5.729578)


def test_mean_and_standard_deviation_are_over_waypoints_of_norms():
    figures = errors_of([waypoint([1e-3, 0, 0], [1, 0, 0]), waypoint([-3e-3, 0, 0], [3, 0, 0])], "measured", 1, None, 1)
    assert figures["go_pose_mm"] == pytest.approx({"mean": 2.0, "std": 1.0})
    assert figures["x_mm"] == pytest.approx({"mean": 2.0, "std": 1.0})  # mean of absolute errors, not of signed ones


def test_components_are_the_extrinsic_objects_where_there_is_one():
    figures = errors_of([waypoint([9e-3, 0, 0], [0, 0, 0], eo=np.array([1e-3, 0, 0]))], "measured", 1, 1, 1)
    assert figures["x_mm"]["mean"] == pytest.approx(1.0)
    assert figures["eo_pose_mm"]["mean"] == pytest.approx(1.0)
    assert figures["go_pose_mm"]["mean"] == pytest.approx(9.0)


def test_an_object_that_was_never_seen_has_no_pose_figure():
    figures = errors_of([waypoint(None, [1, 0, 0])], "measured", 1, None, 1)
    assert figures["go_pose_mm"] is None and figures["wrench_N"]["mean"] == pytest.approx(1.0)


def test_without_waypoints_or_witness_there_are_no_figures():
    assert metrics.errors_of([], "measured", 1, None, 1) is None
    assert metrics.errors_of([waypoint([0, 0, 0], [0, 0, 0])], "truth", 1, None, 1) is None


def test_angle_errors_wrap():
    assert pose_errors([np.array([0, 0, 3.1])], [np.array([0, 0, -3.1])])[0, 2] == pytest.approx(6.2 - 2 * np.pi)


@pytest.mark.parametrize(
    ("fx", "fy", "tau", "rho", "summary", "x", "y", "pose"),
    [  # the paper's Table 3: tall_box and pentagon
        (0.63, 0.77, 86.9, 44.8e-3, 2.18, 0.36, 0.72, 0.805),
        (0.23, 0.34, 26.5, 42.2e-3, 0.75, 1.25, 0.67, 1.419),
    ],
)
def test_the_papers_summaries_follow_from_its_component_means(fx, fy, tau, rho, summary, x, y, pose):
    means = {"fx_N": fx, "fy_N": fy, "tau_Nmm": tau, "x_mm": x, "y_mm": y}
    figures = paper_summary({key: {"mean": value} for key, value in means.items()}, rho)
    assert figures["wrench_summary_N"] == pytest.approx(summary, abs=0.01)
    assert figures["pose_summary_mm"] == pytest.approx(pose, abs=0.002)


BOX = Polygon(np.array([[-0.02, -0.05], [0.02, -0.05], [0.02, 0.05], [-0.02, 0.05]]))
CORNERS = ([-0.02, -0.05], [0.02, -0.05])


def plan_with(*points, modes=None) -> Plan:
    """One step of the box, 0.1 m to the right and turned by 90°, touched at ``points`` of its own frame."""
    in_world = [[0.1 - y, 0.2 + x] for x, y in points]
    count = len(points)
    one = np.zeros((1, 3))
    return Plan(
        name="hand", skill="s", planner="p", X_go_gocf=np.zeros(3), stiffness=np.eye(3), mass=0.1, com=np.zeros(2),
        gravity=9.81, ee=one, go=np.array([[0.1, 0.2, np.pi / 2]]), eo=None, wrench=one,
        contact_names=tuple(map(str, range(count))), contact_points=np.array([in_world]),
        contact_normals=np.tile([0.0, 1.0], (1, count, 1)), contact_forces=np.tile([1.0, 0.0], (1, count, 1)),
        contact_modes=((modes or (Mode.STICK,) * count),), contact_mu=np.full(count, 0.3), preload_ee=one,
        preload_go=one, preload_wrench=one, unload_ee=one, unload_go=one, unload_wrench=one,
    )  # fmt: skip


def believed(*point, status="ok") -> WaypointRecord:
    state = PlanarState(np.zeros(3), np.zeros(3), None, np.zeros(3))
    belief = ContactBelief(status, np.array([point]), np.ones(1))
    return WaypointRecord(0, "t", 0, state, np.zeros(3), state, contact=belief)


def test_a_contact_is_off_by_its_distance_from_the_planned_one_in_the_objects_frame():
    found = contact_of([believed(-0.017, -0.046), believed(-0.02, -0.05)], plan_with(CORNERS[0]), BOX)
    assert found == {"mean_mm": pytest.approx(2.5), "max_mm": pytest.approx(5.0), "waypoints": 2, "not_located": 0}


def test_between_the_two_ends_of_a_face_that_lies_flat_a_contact_is_where_it_should_be():
    found = contact_of([believed(0.005, -0.05), believed(0.02, -0.047)], plan_with(*CORNERS), BOX)
    assert found is not None
    assert found["mean_mm"] == pytest.approx(1.5) and found["max_mm"] == pytest.approx(3.0)


def test_a_place_that_is_not_known_is_counted_and_not_measured():
    found = contact_of([believed(0.0, 0.0, status="ambiguous")], plan_with(CORNERS[0]), BOX)
    assert found == {"mean_mm": None, "max_mm": None, "waypoints": 0, "not_located": 1}


def test_contacts_of_another_body_and_such_as_are_free_are_not_the_objects():
    # the second one lies 20 mm off the box, the third is open
    plan = plan_with(CORNERS[0], [0.04, -0.05], CORNERS[1], modes=(Mode.STICK, Mode.STICK, Mode.FREE))
    found = contact_of([believed(0.02, -0.05)], plan, BOX)
    assert found is not None and found["max_mm"] == pytest.approx(40.0)


def test_where_nobody_looked_for_the_contact_there_is_no_figure():
    state = PlanarState(np.zeros(3), np.zeros(3), None, np.zeros(3))
    assert contact_of([WaypointRecord(0, "t", 0, state, np.zeros(3), state)], plan_with(CORNERS[0]), BOX) is None


def test_the_second_witness_is_summed_up_by_how_far_the_two_were_apart():
    found = [Agreement(np.array([0.03, 0.04]), 1.0, 0.6, True), Agreement(np.array([0.0, -0.15]), 40.0, 1e-9, False)]
    assert witness_of(found) == {"mean_N": pytest.approx(0.1), "max_N": pytest.approx(0.15), "disagreements": 1}
    assert witness_of([]) is None
