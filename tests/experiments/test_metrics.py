"""The error figures against hand-computed values and the paper's own arithmetic."""

import numpy as np
import pytest

from experiments import metrics
from experiments.metrics import paper_summary, pose_errors
from mechanics.records import PlanarState, WaypointRecord


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
