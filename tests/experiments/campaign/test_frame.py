"""The table of a campaign: a row for each trial, and figures that anybody can check by hand."""

import io
import json

import pandas as pd
import pytest
from rich.console import Console

from experiments.campaign.folder import CampaignFolder
from experiments.campaign.frame import cells, comparison_table, comparisons, save, summary_table, trials_frame
from experiments.campaign.sweep import _conclude
from experiments.exit_codes import ExitCode
from mechanics.yaml_input import InputError

from .campaigns import campaign, row


@pytest.fixture
def folder(tmp_path):
    jobs = []
    for mu, wrenches in ((0.3, (1.0, 3.0)), (0.5, (2.0, None))):
        for trial, wrench in enumerate(wrenches):
            status = "completed" if wrench is not None else "slipped"
            rows = [row("open_loop", trial, status, wrench)]
            jobs.append((f"{mu}-{trial}", {"mu": mu, "seed": trial}, rows, [("completed", rows)]))
    return campaign(tmp_path / "sweep", jobs)


def test_there_is_a_row_for_each_trial_with_its_tags_and_figures(folder):
    frame = trials_frame(folder)
    assert frame["mu"].tolist() == [0.3, 0.3, 0.5, 0.5]
    assert frame["measured.wrench_N.mean"].dropna().tolist() == [1.0, 3.0, 2.0]
    assert frame["run"].tolist()[0] == "jobs/0.3-0/run"
    assert {"job", "seed", "skill", "controller", "trial", "status", "reason"} <= set(frame.columns)


def test_cells_pool_seeds_and_tell_rates_means_and_spread(folder):
    first, second = cells(folder, trials_frame(folder))
    assert (first["cell"], first["n"], first["completed"]) == ({"mu": 0.3}, 2, 2)
    assert first["measured"]["wrench_N"] == {"mean": 2.0, "std": 1.0, "n": 2}
    assert first["measured"]["eo_pose_mm"] is None
    # Wilson's interval of 1 in 2: (p + z²/2n ± z √(p q/n + z²/4n²)) / (1 + z²/n) with z = 1.959964
    assert second["success"] == {
        "rate": 0.5,
        "low": pytest.approx(0.09453, abs=1e-5),
        "high": pytest.approx(0.90547, abs=1e-5),
    }
    assert second["measured"]["wrench_N"]["n"] == 1


def test_the_newest_run_that_ended_counts(tmp_path):
    planned = [row("open_loop", 0, "", None)]
    runs = [("running", []), ("device_failed", [row("open_loop", 0, "device_failed", None)])]
    runs.append(("fell_short", [row("open_loop", 0, "lost_contact", 4.0)]))
    folder = campaign(tmp_path / "sweep", [("a", {}, planned, runs)])
    [status], [run] = trials_frame(folder)["status"], trials_frame(folder)["run"]
    assert (status, run) == ("lost_contact", "jobs/a/run.2")


def test_trials_that_a_job_did_not_get_to_have_a_row_that_says_why(tmp_path):
    planned = [row("open_loop", 0, "", None), row("closed_loop", 0, "", None)]
    folder = campaign(
        tmp_path / "sweep",
        [
            ("a", {"k": 1}, planned, [("fell_short", [row("open_loop", 0, "diverged", 4.0)])]),
            ("b", {"k": 2}, planned, [("infeasible", [])]),
            ("c", {"k": 3}, planned, [("device_failed", [row("open_loop", 0, "device_failed", None)])]),
            ("d", {"k": 4}, planned, [("running", [])]),
        ],
    )
    CampaignFolder(folder).job("c").give_up("the camera is off")
    frame = trials_frame(folder)
    told = list(zip(frame["job"], frame["controller"], frame["status"], frame["reason"], strict=True))
    assert told == [
        ("a", "open_loop", "diverged", ""),
        ("a", "closed_loop", "fell_short", "so"),
        ("b", "open_loop", "infeasible", "so"),
        ("b", "closed_loop", "infeasible", "so"),
        ("c", "open_loop", "device_failed", ""),
        ("c", "closed_loop", "failed", "the camera is off"),
    ]  # and d, which has not ended, is not there yet


def test_a_tag_never_hides_another_column(tmp_path):
    planned = [row("open_loop", 0, "completed", 1.0)]
    jobs = [(id, {"sensor": id, "run": 3}, planned, [("completed", planned)]) for id in ("mine", "yours")]
    folder = campaign(tmp_path / "sweep", jobs)
    frame = trials_frame(folder)
    assert frame["grid.sensor"].tolist() == ["mine", "yours"]
    assert frame["sensor"].tolist() == ["soft_bubble"] * 2
    assert frame["run"].tolist() == ["jobs/mine/run", "jobs/yours/run"]
    found = [cell["cell"] for cell in cells(folder, frame)]
    assert found == [{"grid.sensor": "mine", "grid.run": 3}, {"grid.sensor": "yours", "grid.run": 3}]


def test_the_parquet_file_reads_back_with_mixed_tags(tmp_path):
    planned = [row("open_loop", 0, "completed", 1.0)]
    jobs = [(str(i), {"k": tag}, planned, [("completed", planned)]) for i, tag in enumerate([1, 0.5, "word", True])]
    folder = campaign(tmp_path / "sweep", jobs)
    save(folder, {}, trials_frame(folder))
    assert pd.read_parquet(folder / "trials.parquet")["k"].tolist() == ["1", "0.5", "word", "True"]


def test_a_campaign_of_which_nothing_ran_has_an_empty_table(tmp_path):
    folder = campaign(tmp_path / "sweep", [("a", {"k": 1}, [], [])])
    frame = trials_frame(folder)
    assert len(frame) == 0
    assert cells(folder, frame) == []
    assert comparisons(folder, frame) == []
    save(folder, {}, frame)


def test_the_terminal_shows_every_cell(folder):
    console = Console(width=100, record=True, force_terminal=False)
    console.print(summary_table("sweep", cells(folder, trials_frame(folder))))
    first, second = [line.split() for line in console.export_text().splitlines() if "open_loop" in line]
    assert first == ["0.3", "open_loop", "2", "100%", "(34%–100%)", "2.000", "±", "1.000"]
    assert second == ["0.5", "open_loop", "2", "50%", "(9%–91%)", "2.000", "±", "0.000"]


@pytest.fixture
def pairs(tmp_path):
    """Two cells of two seeds with two trials each: the second law is 0.1, 0.2, 0.3, 0.6 below the first."""
    jobs = []
    for mu, below in ((0.3, (0.1, 0.2, 0.3, 0.6)), (0.5, (0.4, None, None, None))):
        for number, less in enumerate(below):
            seed, trial = divmod(number, 2)
            level = 10.0 * seed + trial  # what the trials of a pair share
            rows = [row("open_loop", trial, "completed", level), row("closed_loop", trial, "completed", None)]
            if less is not None:
                rows[1] = row("closed_loop", trial, "completed", level - less)
            jobs.append((f"{mu}-s{seed}-t{trial}", {"mu": mu, "seed": seed}, rows, [("completed", rows)]))
    return campaign(tmp_path / "sweep", jobs)


def test_controllers_are_compared_over_pairs_of_one_seed_and_trial(pairs):
    first, second = comparisons(pairs, trials_frame(pairs))
    assert (first["cell"], first["skill"], first["a"], first["b"]) == (
        {"mu": 0.3},
        "grasped_static",
        "closed_loop",
        "open_loop",
    )
    # the mean of −0.1, −0.2, −0.3, −0.6 is −0.3, their deviation 0.21602; Student's t for 4 is 3.1824
    half = 3.1824 * 0.21602 / 2
    expected = {"mean": -0.3, "low": -0.3 - half, "high": -0.3 + half, "n": 4}
    assert first["measured"]["wrench_N"] == pytest.approx(expected, abs=1e-4)
    assert first["measured"]["eo_pose_mm"] is None
    assert second["measured"]["wrench_N"] == {"mean": pytest.approx(-0.4), "low": None, "high": None, "n": 1}


def test_the_terminal_shows_the_differences_that_have_an_interval(pairs):
    console = Console(width=100, record=True, force_terminal=False)
    console.print(comparison_table(comparisons(pairs, trials_frame(pairs))))
    lines = [line.split() for line in console.export_text().splitlines()]
    [at] = [i for i, line in enumerate(lines) if "open_loop" in line]
    assert lines[at] == ["0.3", "closed_loop", "−", "open_loop", "4", "-0.300"]
    assert lines[at + 1] == ["-0.644…+0.044"]


def test_a_summary_that_cannot_be_written_is_shown_and_said(pairs, tmp_path):
    (tmp_path / "file").write_text("no folder")
    shown, said = (Console(width=100, record=True, file=io.StringIO()) for _ in range(2))
    kept = _conclude(pairs, ExitCode.DONE, tmp_path / "file" / "x.json", shown, said)
    assert not kept
    text = shown.export_text()
    assert "sweep of e" in text and "closed_loop − open_loop" in text
    [line] = said.export_text().splitlines()
    assert "write" in line and str(pairs) in line
    assert _conclude(pairs, ExitCode.DONE, tmp_path / "x.json", shown, said)
    [first, _] = json.loads((tmp_path / "x.json").read_text())["comparisons"]
    assert first["measured"]["wrench_N"]["n"] == 4
    assert str(pairs / "report.html") in shown.export_text()
    assert (pairs / "report.html").is_file()


def test_a_report_that_cannot_be_made_takes_nothing_with_it(pairs, tmp_path):
    (pairs / "report.html").mkdir()
    shown, said = (Console(width=200, record=True, file=io.StringIO()) for _ in range(2))
    assert _conclude(pairs, ExitCode.DONE, None, shown, said)
    assert (pairs / "trials.parquet").is_file()
    text = said.export_text()
    assert "the report could not be made" in text and f"extrinsic report {pairs}" in text


def test_one_controller_is_compared_with_nobody(folder):
    assert comparisons(folder, trials_frame(folder)) == []
    assert not comparison_table([]).row_count


def test_a_folder_without_a_campaign_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"no campaign\.json"):
        trials_frame(tmp_path)
