"""A device that fails in the middle of a trial ends the run with its name, and never with a wrong figure."""

import pytest


@pytest.mark.parametrize(
    ("fault", "device"),
    [
        ("{kind: freeze, device: wrist_ft, after: 6}", "wrist_ft"),
        ("{kind: bias, device: arm, after: 6, value: 0.05}", "arm"),
    ],
)
def test_a_device_that_fails_in_mid_trial_ends_the_run_with_its_name(command, fault, device):
    finished = command.run("grasped_static", "--set", f"world.faults=[{fault}]")
    assert finished.code == 3
    assert finished.results["status"] == "device_failed"
    first = finished.results["trials"][0]
    assert first["status"] == "device_failed"
    assert first["reason"].startswith(f"{device}: ")
    assert (finished.folder / "report.html").exists()


@pytest.mark.parametrize(
    ("fault", "key", "nearest"),
    [
        ("{kind: drop, device: wirst_ft, value: 0.1}", "world.faults.0.device", "wrist_ft"),
        ("{kind: freese, device: wrist_ft}", "world.faults.0.kind", "freeze"),
        ("{kind: freeze, devise: wrist_ft}", "world.faults.0.devise", "device"),
        ("{kind: drop, device: wrist_ft}", "world.faults.0.value", None),
        ("{kind: drop, device: wrist_ft, value: 2}", "world.faults.0.value", None),
        ("{kind: bias, device: camera, value: 1}", "world.faults.0.kind", None),
        ("{kind: freeze, device: wrist_ft, value: 1}", "world.faults.0.value", None),
        ("{kind: delay, device: wrist_ft, value: 0}", "world.faults.0.value", None),
    ],
)
def test_a_fault_that_cannot_be_is_bad_input(fault, key, nearest):
    from experiments.files import load
    from mechanics.yaml_input import InputError

    with pytest.raises(InputError) as caught:
        load("grasped_static", None, [f"world.faults=[{fault}]"])
    [problem] = caught.value.problems
    assert problem.key == key
    assert problem.expected
    assert problem.nearest == (nearest or "")
