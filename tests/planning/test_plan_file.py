"""Plan files: they come back to the last bit, and what is none is refused by name with what to do."""

import pickle
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from planning.plan_file import PlanFileError, load, save
from planning.planner import plan
from planning.skills.base import SKILLS


@pytest.fixture(params=["grasped_static", "static_in_contact"], scope="module")
def p(request, scene_of):
    skill = SKILLS[request.param]
    shape = "hbox" if skill.needs_extrinsic else None
    return plan(skill.task(skill.Parameters(), scene_of(shape)), "p", provenance={"git": "abc", "seed": 3})


@pytest.fixture
def file(p, tmp_path):
    return save(p, tmp_path / "plan.npz")


def test_a_plan_comes_back_from_its_file_to_the_last_bit(p, file):
    back = load(file)
    for field in fields(p):
        before, after = getattr(p, field.name), getattr(back, field.name)
        assert type(before) is type(after)
        assert np.array_equal(before, after) if isinstance(before, np.ndarray) else before == after
    assert back.provenance["git"] == "abc"


def test_numpy_alone_reads_the_arrays(p, file):
    with np.load(file, allow_pickle=False) as archive:
        np.testing.assert_array_equal(archive["ee"], p.ee)


def test_saving_replaces_the_file_whole_and_leaves_nothing_else(p, file):
    save(p, file)
    assert [path.name for path in file.parent.iterdir()] == ["plan.npz"]


def test_a_failed_save_leaves_the_old_file_and_no_half_one(p, file, monkeypatch):
    before = file.read_bytes()

    def full(*_args, **_arrays):
        raise OSError("no space left on device")

    monkeypatch.setattr(np, "savez", full)
    with pytest.raises(OSError, match="no space left"):
        save(p, file)
    assert file.read_bytes() == before
    assert [path.name for path in file.parent.iterdir()] == ["plan.npz"]


def test_another_suffix_is_refused(p, tmp_path):
    with pytest.raises(ValueError, match=r"expected a name that ends in \.npz, received 'plan\.yaml'"):
        save(p, tmp_path / "plan.yaml")


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(PlanFileError, match=r"none\.npz: there is no such file: give the path of a plan"):
        load(tmp_path / "none.npz")


@pytest.mark.parametrize("kept", [0, 10, 0.5, 0.9, -1])
def test_a_file_that_was_cut_off_is_refused(file, kept):
    whole = file.read_bytes()
    file.write_bytes(whole[: kept if isinstance(kept, int) else int(kept * len(whole))])
    with pytest.raises(PlanFileError, match="damaged, or no plan"):
        load(file)


def test_a_file_with_a_flipped_bit_in_an_array_is_refused(p, file):
    whole = bytearray(file.read_bytes())
    at = whole.find(p.ee.tobytes())
    assert at > 0
    whole[at + 5] ^= 4
    file.write_bytes(whole)
    with pytest.raises(PlanFileError, match="damaged, or no plan"):
        load(file)


@pytest.mark.parametrize("content", [b"name: plan\n", pickle.dumps({"ee": 1}), b"PK\x03\x04"])
def test_a_file_of_another_kind_is_refused(tmp_path, content):
    path = tmp_path / "plan.npz"
    path.write_bytes(content)
    with pytest.raises(PlanFileError, match="damaged, or no plan"):
        load(path)


def rewritten(file: Path, **changes) -> Path:
    with np.load(file) as archive:
        arrays = {key: archive[key] for key in archive.files}
    np.savez(file, **{**arrays, **changes})
    return file


def test_a_plan_of_another_schema_is_refused_with_the_remedy(file):
    with np.load(file) as archive:
        rest = str(archive["plan"])
    rewritten(file, plan=np.array(rest.replace('"schema": 2', '"schema": 1')))
    with pytest.raises(PlanFileError, match="schema 1, this version reads 2: plan again with this version") as caught:
        load(file)
    assert caught.value.remedy == "plan again with this version"


def test_an_archive_with_another_array_or_a_wrong_shape_is_refused(file):
    with pytest.raises(PlanFileError, match=r"go: expected shape"):
        load(rewritten(file, go=np.zeros((3, 3))))
    with pytest.raises(PlanFileError, match=r"not known \['colour'\]"):
        load(rewritten(file, colour=np.zeros(2)))


def test_an_archive_of_something_else_is_refused(tmp_path):
    np.savez(tmp_path / "x.npz", a=np.zeros(3))
    with pytest.raises(PlanFileError, match="damaged, or no plan"):
        load(tmp_path / "x.npz")


def test_an_error_survives_a_trip_between_processes():
    error = PlanFileError("a.npz", "damaged")
    assert str(pickle.loads(pickle.dumps(error))) == str(error) == "a.npz: damaged: plan again"
