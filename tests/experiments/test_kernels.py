"""Where compiled kernels are kept, whatever may be written."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from experiments import kernels


@pytest.fixture(autouse=True)
def nothing_said(monkeypatch, tmp_path):
    # set first, so that what `keep` sets is taken back: the next test's run would compile everything anew
    monkeypatch.setenv(kernels.VARIABLE, "")
    monkeypatch.delenv(kernels.VARIABLE)
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))


def only_temporary(monkeypatch, tmp_path):
    monkeypatch.setattr(kernels, "_may_write", lambda folder: folder.is_relative_to(tmp_path))


def test_numba_decides_where_it_may_write():
    kernels.keep()
    assert kernels.VARIABLE not in os.environ


def test_a_folder_that_is_asked_for_is_kept(monkeypatch, tmp_path):
    only_temporary(monkeypatch, tmp_path)
    monkeypatch.setenv(kernels.VARIABLE, "/mine")
    kernels.keep()
    assert os.environ[kernels.VARIABLE] == "/mine"


def test_where_nothing_may_be_written_a_private_temporary_folder_serves_at_each_start(monkeypatch, tmp_path):
    only_temporary(monkeypatch, tmp_path)
    monkeypatch.setattr(kernels, "_user_cache", lambda: Path("/nowhere"))
    found = []
    for _ in range(2):
        monkeypatch.delenv(kernels.VARIABLE, raising=False)
        kernels.keep()
        found.append(Path(os.environ[kernels.VARIABLE]))
    assert found[0] == found[1]
    assert found[0].is_relative_to(tmp_path)
    assert found[0].stat().st_mode & 0o077 == 0


def test_a_temporary_folder_that_others_may_write_is_not_trusted(monkeypatch, tmp_path):
    only_temporary(monkeypatch, tmp_path)
    monkeypatch.setattr(kernels, "_user_cache", lambda: Path("/nowhere"))
    foreign = tmp_path / f"extrinsic-kernels-{os.getuid()}"
    foreign.mkdir()
    foreign.chmod(0o777)
    kernels.keep()
    assert Path(os.environ[kernels.VARIABLE]) != foreign
    assert Path(os.environ[kernels.VARIABLE]).stat().st_mode & 0o077 == 0


def test_a_folder_is_writable_if_it_could_be_made(tmp_path):
    assert kernels._may_write(tmp_path / "a" / "b")
    (tmp_path / "file").touch()
    assert not kernels._may_write(tmp_path / "file" / "b")
