"""docs/add-a-*.md, each followed as it stands in an empty folder, and what its new thing leaves in results.json."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.pages import ROOT, Reader, assert_shown, blocks

DOCS = ROOT / "docs"
#: a page installs a package, runs an experiment and its own tests, one after the other
pytestmark = pytest.mark.timeout(600)


@pytest.fixture
def followed(tmp_path):
    """What runs on a page have left, by its name: their results by the folder's name."""

    def follow(name: str) -> dict[str, dict]:
        reader = Reader(tmp_path)
        reader.follow(DOCS / f"add-a{name}.md")
        found = {file.parent.name: json.loads(file.read_text()) for file in reader.folder.glob("*/results.json")}
        assert found, "the page runs nothing"
        return found

    return follow


def errors(results: dict, controller: str) -> dict:
    [trial] = [trial for trial in results["trials"] if trial["controller"] == controller]
    assert trial["status"] == "completed"
    return trial["measured"]


def test_a_shape_of_ones_own_is_tipped(followed):
    results = followed("-shape")["tipped"]
    assert {trial["extrinsic_object"] for trial in results["trials"]} == {"l_block"}
    # feedback does here what it does with the objects that are shipped
    assert errors(results, "closed_loop_pi")["wrench_N"]["mean"] < errors(results, "open_loop")["wrench_N"]["mean"]


def test_a_station_of_ones_own_runs_with_its_own_rates(followed):
    results = followed("-station")["pressed"]
    assert (results["station"], results["profile"]) == ("bench", "lab")
    assert results["streams"]["wrist_ft"]["rate_Hz"] == pytest.approx(500, rel=0.05)
    assert errors(results, "closed_loop")["wrench_N"]["mean"] < 0.5


def test_a_controller_of_ones_own_does_what_its_page_says(followed):
    results = followed("-controller")["pressed"]
    blind, seeing = errors(results, "open_loop"), errors(results, "dead_band")
    # springs that are softer by a fifth press less by as much of what the sensor presses, 3 to 5 N less 0.98 of weight
    assert blind["fy_N"]["mean"] == pytest.approx(0.2 * (4 - 0.98), rel=0.1)
    # along axes that are tilted by 15°: its band, and what 28 % of a fifth of 0.4 N more at each waypoint adds up to
    assert 0.1 < seeing["fy_N"]["mean"] < 0.2
    assert results["provenance"]["versions"]["dead-band"] == "0.1.0"


def test_an_optimiser_of_ones_own_plans_within_its_budget(followed):
    results = followed("n-optimiser")["tipped"]
    evolved, sampled = results["plans"]
    assert (evolved["planner"], sampled["planner"]) == ("one_plus_one", "mppi")
    assert evolved["queries"] == sampled["queries"] == 1000
    assert results["provenance"]["versions"]["one-plus-one"] == "0.1.0"
    errors(results, "open_loop")


def test_a_skill_of_ones_own_is_planned_and_executed(followed):
    results = followed("-skill")["rocked"]
    [plan] = results["plans"]
    assert (plan["skill"], plan["steps"], plan["status"]) == ("grasped_rocking", 9, "solved")
    assert {trial["skill"] for trial in results["trials"]} == {"grasped_rocking"}
    assert errors(results, "closed_loop_pi")["wrench_N"]["mean"] < errors(results, "open_loop")["wrench_N"]["mean"]


# -- how a page is followed --------------------------------------------------------------------------------------------


def test_blocks_are_files_commands_and_what_is_shown(tmp_path):
    page = tmp_path / "page.md"
    page.write_text("```yaml\n# file: a.yaml\nx: 1\n```\n\n```sh\ncat a.yaml\n```\n\n```text\nx: …\n```\n")
    assert [(block.language, block.file) for block in blocks(page)] == [("yaml", "a.yaml"), ("sh", ""), ("text", "")]
    Reader(tmp_path).follow(page)


@pytest.mark.parametrize("shown", ["x: 2", "x: 1\nx: 1", "y: 1", "x: 1 more"], ids=["figure", "again", "word", "more"])
def test_what_a_page_shows_and_nothing_prints_is_an_error(shown):
    with pytest.raises(AssertionError, match="is not printed"):
        assert_shown(shown, "x: 1\nz: 3\n")


@pytest.mark.parametrize("shown", ["x:   0.601 ± 0.14", "…\n3 trials", "x: …\n3 …"])
def test_figures_are_compared_as_measurements_and_what_is_left_out_is_not(shown):
    assert_shown(shown, "x: 0.59 ± 0.15\n3 trials\n")


@pytest.mark.parametrize("line", ["false", "true   # exit code 2"])
def test_a_command_that_does_not_end_as_the_page_says_is_an_error(tmp_path, line):
    with pytest.raises(AssertionError, match=line.split()[0]):
        Reader(tmp_path).run(line)


def test_every_howto_is_followed():
    own = {"add-a-device.md"}  # tests/drivers/test_howto_add_a_device.py
    followed_here = {f"add-a{name}.md" for name in ("-shape", "-station", "-controller", "n-optimiser", "-skill")}
    assert {page.name for page in Path(DOCS).glob("add-a*.md")} == own | followed_here
