"""The small table of these tests, and what makes its trials up."""

import pytest

from tests.experiments.table.table_cases import SMALL, Made


@pytest.fixture
def made():
    return Made()


@pytest.fixture
def small(tmp_path):
    """The small table's file."""
    file = tmp_path / "small.yaml"
    file.write_text(SMALL)
    return file
