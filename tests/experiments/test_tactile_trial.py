"""A trial whose controller learns the object's pose from the fingers, and from nothing else."""

from __future__ import annotations

import numpy as np

from drivers.wire.log_reader import LogReader
from mechanics import se2
from mechanics.records import WaypointRecord

TACTILE = (
    "--set",
    "trial.go_pose=tactile",
    "--set",
    "stages.0.parameters.steps=3",
    "--set",
    "stages.1.controllers=[closed_loop]",
)


def test_closed_loop_on_the_fingers_alone_works_in_a_lab_and_what_it_was_told_is_logged(command) -> None:
    finished = command.run("grasped_static", *TACTILE, "--set", "world.profile=lab", "--set", "seed=1")
    [trial] = finished.results["trials"]
    assert trial["status"] == "completed" and trial["go_pose"] == "tactile"
    # the paper's own closed-loop row, on its hardware: 0.94 mm, 0.45 N
    assert trial["truth"]["go_pose_mm"]["mean"] < 0.94
    records = [r for _, r in LogReader(finished.folder / "log.mcap").values() if isinstance(r, WaypointRecord)]
    assert len(records) == 3
    for record in records:
        told, truth = record.estimated, record.truth
        assert told is not None and told.go is not None and truth is not None and truth.go is not None
        error = se2.between(se2.between(truth.ee, truth.go), se2.between(told.ee, told.go))
        assert np.hypot(*error[:2]) < 1e-3 and abs(error[2]) < np.radians(2)
        assert not np.array_equal(told.go, record.measured.go)  # type: ignore[arg-type]
        # the corner that it stands on, by the fingers, the wrist and the ground that the plan is anchored to
        assert record.contact is not None and record.contact.point is not None
        touched = se2.transform(truth.go, record.contact.point)
        assert abs(touched[1]) < 1e-4  # the ground
    assert trial["contact"]["not_located"] == 0 and trial["witness"]["disagreements"] == 0


def test_fingers_that_see_nothing_end_the_run_with_their_names(command) -> None:
    both = "[{kind: saturate, device: finger_left, value: 300}, {kind: saturate, device: finger_right, value: 300}]"
    finished = command.run("grasped_static", *TACTILE, "--set", f"world.faults={both}")
    assert finished.code == 3
    [trial] = finished.results["trials"]
    assert trial["status"] == "device_failed"
    assert trial["reason"].startswith("finger_left, finger_right: feel the grasped object")
