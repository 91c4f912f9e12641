"""docs/paper.md: from the paper's sections to files and names that exist."""

import ast
import re

import pytest

from tests.docs.conftest import ROOT

PAGE = (ROOT / "docs" / "paper.md").read_text(encoding="utf-8")
ROWS = [
    (number, [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]])
    for number, line in enumerate(PAGE.splitlines(), 1)
    if line.startswith("| ") and not line.startswith("| in the paper")
]


def names_in(path):
    """What a Python file defines at its top, and in its classes as ``Class.name``."""
    found = set()
    for node in ast.parse((ROOT / path).read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add(node.name)
        if isinstance(node, ast.ClassDef):
            found |= {f"{node.name}.{inner.name}" for inner in node.body if isinstance(inner, ast.FunctionDef)}
    return found


@pytest.mark.parametrize("row", [row for _, row in ROWS], ids=[f"line{number}" for number, _ in ROWS])
def test_files_and_names_of_a_row_exist(row):
    files, names = re.findall(r"`([^`]+)`", row[1]), re.findall(r"`([^`]+)`", row[2])
    assert files, row
    known = set()
    for file in files:
        assert (ROOT / file).is_file(), file
        if file.endswith(".py"):
            known |= names_in(file)
    assert names or not known, row
    assert set(names) <= known, f"{sorted(set(names) - known)}: not in {files}"


def test_every_section_of_the_method_and_the_experiments_has_its_table():
    headings = re.findall(r"^## (.+)$", PAGE, re.MULTILINE)
    assert headings == [
        "Problem statement",
        "Tactile state estimation",
        "Tactile elasticity model",
        "Extrinsic contact model",
        "Extrinsic contact trajectory optimisation",
        "Experiments and results",
    ]


def test_every_skill_controller_and_optimiser_that_the_project_has_is_placed():
    from experiments import registries

    for kind in (registries.skills(), registries.controllers(), registries.optimisers()):
        for name, one in kind.items():
            assert f"`{one.__name__}`" in PAGE, name
