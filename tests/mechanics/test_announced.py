"""What packages announce by entry points: found without being imported, and never without a name where it is wrong."""

from __future__ import annotations

import sys

import pytest

from mechanics import announced
from mechanics.yaml_input import Refusal
from tests.installed import installer

GROUP = "extrinsic.tests"


@pytest.fixture
def install(tmp_path):
    with installer(tmp_path) as install:
        yield install


def load(name, expected=lambda _found: None):
    return announced.load(GROUP, "thing", name, expected, at=("here",))


def test_names_are_known_and_nothing_is_imported_before_one_is_asked_for(install):
    install("some-parts", GROUP, "raise RuntimeError", b="some_parts:B", a="some_parts:A")
    install("other-parts", GROUP, "C = 3", c="other_parts:C")
    assert announced.names(GROUP) == ("a", "b", "c")
    assert announced.names("extrinsic.none_of_this_name") == ()
    assert load("c") == 3
    assert "some_parts" not in sys.modules


def test_the_version_of_a_package_is_told_once_something_of_it_is_used(install):
    install("told-parts", GROUP, "A = 1", a="told_parts:A")
    assert "told-parts" not in announced.loaded()
    load("a")
    assert announced.loaded()["told-parts"] == "1.2"


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ("import nothing_of_this_name", "ModuleNotFoundError: No module named 'nothing_of_this_name'"),
        ("1 / 0", "ZeroDivisionError: division by zero"),
        ("raise SystemExit('no licence')", "SystemExit: no licence"),
        ("B = 1", "AttributeError"),
        ("A = (", "SyntaxError"),
    ],
)
def test_a_package_that_cannot_be_imported_is_named_with_its_version_and_the_reason(install, source, reason):
    install("broken-parts", GROUP, source, a="broken_parts:A")
    with pytest.raises(Refusal) as e:
        load("a")
    assert e.value.wrong.startswith("thing 'a' of broken-parts 1.2 (broken_parts:A) cannot be imported: ")
    assert reason in e.value.wrong
    assert e.value.at == ("here",)


def test_a_thing_of_another_kind_is_refused_with_what_should_be_there(install):
    install("odd-parts", GROUP, "A = 1", a="odd_parts:A")
    with pytest.raises(Refusal, match=r"thing 'a' of odd-parts 1.2 \(odd_parts:A\) is a int") as e:
        load("a", lambda found: None if isinstance(found, str) else "text")
    assert e.value.expected == "text"
    assert "odd-parts" not in announced.loaded()


def test_two_packages_with_one_name_are_both_named(install):
    install("first-parts", GROUP, "A = 1", a="first_parts:A")
    install("second-parts", GROUP, "A = 2", a="second_parts:A")
    assert announced.names(GROUP) == ("a",)
    with pytest.raises(Refusal, match=r"by first-parts 1.2 \(first_parts:A\) and second-parts 1.2 \(second_parts:A\)"):
        load("a")
