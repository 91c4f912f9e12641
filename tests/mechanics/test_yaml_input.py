"""Files from a person: what is read, what is refused, and what the refusal says."""

from __future__ import annotations

import io
import json
import string
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import AfterValidator, BaseModel, ConfigDict, Field
from ruamel.yaml import YAML

from mechanics import model_paths
from mechanics.yaml_input import InputError, Refusal, locate, parse, read_text, read_yaml, set_key


class Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


def _even(value: int) -> int:
    if value % 2:
        raise Refusal(f"{value} is odd", "an even number", "2")
    return value


class Ball(Strict):
    kind: Literal["ball"]
    radius: float = Field(gt=0, description="radius [m]")


class Bar(Strict):
    kind: Literal["bar"]
    length: float = 1.0
    ends: tuple[float, float] = (0.0, 1.0)


class Thing(Strict):
    name: str
    mass: float = Field(default=1.0, gt=0, description="mass [kg]")
    colour: Literal["red", "green"] = "red"
    count: Annotated[int, AfterValidator(_even)] = 2
    force: float | tuple[float, float] = 1.0
    parts: tuple[Annotated[Ball | Bar, Field(discriminator="kind")], ...] = ()
    friction: dict[Literal["go-ground", "go-eo"], float] = {}
    named: dict[str, Ball] = {}
    maybe: Ball | None = None


def problem(text: str):
    """The only problem that ``text`` has as a Thing."""
    with pytest.raises(InputError) as e:
        parse(Thing, read_text(text, "thing.yaml"))
    assert len(e.value.problems) == 1, str(e.value)
    assert str(e.value.problems[0]) == str(e.value)
    return e.value.problems[0]


def fault(text: str):
    """The only problem that ``text`` has as YAML."""
    with pytest.raises(InputError) as e:
        read_text(text, "thing.yaml")
    return e.value.problems[0]


# -- reading ---------------------------------------------------------------------------------------------------------

keys = st.text(string.ascii_letters + "_- äß", min_size=1, max_size=8)
scalars = (
    st.none() | st.booleans() | st.integers(-(10**18), 10**18) | st.floats(allow_nan=False, allow_infinity=False)
) | st.text(st.characters(exclude_categories=["Cs", "Cc"]), max_size=12).filter(
    lambda text: not text.startswith("?")  # ruamel writes it plain into a flow mapping, where it cannot read it back
)
data = st.dictionaries(
    keys,
    st.recursive(scalars, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=4)),
    min_size=1,
    max_size=4,
)


@settings(max_examples=60, deadline=None)
@given(data)
def test_json_is_read_as_json_reads_it(value):
    assert read_text(json.dumps(value, ensure_ascii=False), "x").data == value


@settings(max_examples=60, deadline=None)
@given(data)
def test_plain_yaml_is_read_as_ruamel_reads_it(value):
    out = io.StringIO()
    writer = YAML(typ="safe", pure=True)
    writer.default_flow_style, writer.width = False, 4096  # what ruamel folds or writes in flow it cannot always read
    writer.dump(value, out)
    assert read_text(out.getvalue(), "x").data == YAML(typ="safe", pure=True).load(out.getvalue())


@settings(max_examples=150, deadline=None)
@given(st.text(st.sampled_from("ab1.-:,#&*!|>'\"%@`{}[]?~<\n \t\\\0é"), max_size=60) | st.text(max_size=30))
def test_any_text_is_read_or_refused_as_input(text):
    try:
        document = read_text(text, "x")
    except InputError:
        return
    assert isinstance(document.data, dict)


@settings(deadline=None)
@given(st.binary(max_size=60))
def test_any_bytes_are_read_or_refused_as_input(tmp_path_factory, content):
    path = tmp_path_factory.getbasetemp() / "bytes.yaml"
    path.write_bytes(content)
    try:
        read_yaml(path)
    except InputError as e:
        assert str(path) in str(e)


@pytest.mark.parametrize(
    ("written", "value"),
    [
        ("1e-3", 0.001),
        ("-1E+2", -100.0),
        (".5", 0.5),
        ("5.", 5.0),
        ("007", 7),
        ("0x1f", 31),
        ("+3", 3),
        ("1_000", "1_000"),
        ("on", "on"),
        ("no", "no"),
        ("true", True),
        ("~", None),
        ("", None),
        ("'1e-3'", "1e-3"),
        ("2024-01-01", "2024-01-01"),
        ("12:30", "12:30"),
    ],
)
def test_plain_scalars_follow_the_core_schema_of_yaml_1_2(written, value):
    read = read_text(f"a: {written}\n", "x").data["a"]
    assert read == value
    assert type(read) is type(value)


def test_each_key_and_item_has_its_line():
    document = read_text("a: 1\nb:\n  - x\n  -\n    c: 2\nd: {e: 3}\n", "x")
    assert document.positions[("a",)] == 1
    assert document.positions[("b", 0)] == 3
    assert document.positions[("b", 1, "c")] == 5
    assert document.positions[("d", "e")] == 6


def test_an_alias_is_a_copy():
    document = read_text("a: &x [1, 2]\nb: *x\n", "x")
    assert document.data == {"a": [1, 2], "b": [1, 2]}
    assert set_key(document, "b.0", "9").data == {"a": [1, 2], "b": [9, 2]}


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("", None, "empty"),
        ("# only a comment\n", None, "empty"),
        ("---\n...\n", None, "empty"),
        ("- a\n- b\n", 1, "list of 2"),
        ("just text\n", 1, "just text"),
        ("a: 1\nb: [1, 2\nc: 3\n", 3, "not YAML"),
        ("a: 1\n\tb: 2\n", 2, "not YAML"),
        ("a: 'x\n", None, "not YAML"),
        ("a: 1\nb: 2\na: 3\n", 3, "'a' stands twice, first on line 1"),
        ("a: 1\n---\nb: 2\n", 2, "second document"),
        ("a: !!python/object/apply:os.system ['true']\n", 1, "tag"),
        ("a: !custom 3\n", 1, "tag"),
        ("a: .nan\n", 1, "not finite"),
        ("a: 1\nb: -.inf\n", 2, "not finite"),
        ("a: 1e999\n", 1, "not finite"),
        (f"a: {'9' * 400}\n", 1, "400 digits"),
        ("1: a\n", 1, "key '1' is no text"),
        ("a: {<<: 3}\n", 1, "merge keys"),
        ("a: *b\n", 1, "b"),
        ("a: &b [*b]\n", 1, "nothing that is complete"),
        ('a: "\\ud800"\n', 1, "surrogate"),
        ("a: \0\n", None, "not YAML"),
        ("[a]: 1\n", 1, "a key is a list"),
        ("? {b: 1}\n: 1\n", 1, "a key is a list"),
    ],
)
def test_text_that_is_no_plain_mapping_is_refused_at_its_line(text, line, says):
    found = fault(text)
    assert found.file == "thing.yaml"
    assert says in found.wrong
    assert found.expected
    if line is not None:
        assert found.line == line


@pytest.mark.parametrize("opening", ["[", "{a: ", "- ", "? "])
def test_a_hundred_thousand_levels_are_refused_and_not_a_crash(opening):
    assert fault("a: " + opening * 100_000 if opening in "[{a: " else opening * 100_000).file == "thing.yaml"


def test_indented_levels_are_counted():
    text = "".join("  " * i + "a:\n" for i in range(40))
    assert "nested more than" in fault(text).wrong


def test_levels_and_values_are_counted_through_aliases():
    bomb = "a0: &a0 [1, 1]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
    assert "more than" in fault(bomb).wrong
    ladder = "a0: &a0 [1]\n" + "".join(f"a{i}: &a{i} [*a{i - 1}]\n" for i in range(1, 60))
    assert "nested more than" in fault(ladder).wrong


def test_a_missing_file_a_folder_a_binary_and_a_huge_file_are_refused_by_name(tmp_path):
    (tmp_path / "binary.yaml").write_bytes(b"a: 1\nb: \xff\xfe")
    (tmp_path / "huge.yaml").write_text("a: 1\n" * 100_000)
    for path, says in [
        (tmp_path / "none.yaml", "no such file"),
        (tmp_path, "folder"),
        (tmp_path / "binary.yaml", "UTF-8"),
        (tmp_path / "huge.yaml", "KiB"),
        ("/dev/null", "ordinary file"),
    ]:
        with pytest.raises(InputError, match=says) as e:
            read_yaml(path)
        assert e.value.problems[0].file == str(path)
    with pytest.raises(InputError) as e:
        read_yaml(tmp_path / "binary.yaml")
    assert e.value.problems[0].line == 2


def test_a_byte_order_mark_and_windows_line_ends_are_read(tmp_path):
    (tmp_path / "x.yaml").write_bytes(b"\xef\xbb\xbfa: 1\r\nb: 2\r\n")
    assert read_yaml(tmp_path / "x.yaml").data == {"a": 1, "b": 2}


# -- models ----------------------------------------------------------------------------------------------------------


def test_a_good_file_becomes_its_model():
    thing = parse(Thing, read_text("name: a\nforce: [1, 2]\nparts: [{kind: bar, ends: [1, 2]}]\n", "x"))
    assert thing == Thing(name="a", force=(1, 2), parts=(Bar(kind="bar", ends=(1, 2)),))


def test_an_unknown_key_names_line_key_valid_keys_and_the_nearest():
    found = problem("name: a\nmas: 2\n")
    assert (found.file, found.line, found.key, found.nearest) == ("thing.yaml", 2, "mas", "mass")
    assert "colour" in found.expected
    assert str(found).splitlines()[0] == "thing.yaml, line 2: mas: unknown key"


@pytest.mark.parametrize(
    ("text", "line", "key", "wrong", "expected", "nearest"),
    [
        ("name: a\nmass: -1", 2, "mass", "-1", "greater than 0 (mass [kg])", ""),
        ("name: a\nmass: heavy", 2, "mass", "'heavy'", "a number (mass [kg])", ""),
        ("name: a\nmass: '3'", 2, "mass", "'3'", "a number", ""),
        ("name: a\nmass: true", 2, "mass", "true", "a number", ""),
        ("name: a\nmass:", 2, "mass", "nothing", "a number", ""),
        ("name: a\nmass: [1]", 2, "mass", "a list of 1", "a number", ""),
        ("name: 3", 1, "name", "the number 3", "text", ""),
        ("mass: 3", 1, "name", "missing key", "text", ""),
        ("name: a\ncount: 2.5", 2, "count", "2.5", "a whole number", ""),
        ("name: a\ncount: 3", 2, "count", "3 is odd", "an even number", "2"),
        ("name: a\ncolour: rad", 2, "colour", "unknown value 'rad'", "one of green, red", "red"),
        ("name: a\nforce: hard", 2, "force", "'hard'", "a number or a list of 2", ""),
        ("name: a\nforce: [1]", 2, "force", "a list of 1", "a number or a list of 2", ""),
        ("name: a\nparts:\n- kind: bal\n", 3, "parts.0.kind", "'bal'", "one of ball, bar", "ball"),
        ("name: a\nparts:\n- radius: 1\n", 3, "parts.0.kind", "missing key", "'kind'", ""),
        ("name: a\nparts:\n- kind: ball\n", 3, "parts.0.radius", "missing key", "a number (radius [m])", ""),
        ("name: a\nparts:\n- kind: ball\n  radius: 0\n", 4, "parts.0.radius", "0", "greater than 0", ""),
        ("name: a\nparts:\n- kind: bar\n  lenght: 0\n", 4, "parts.0.lenght", "unknown key", "length", "length"),
        ("name: a\nparts:\n- kind: bar\n  ends: [1]\n", 4, "parts.0.ends", "too few", "a list of 2", ""),
        ("name: a\nparts:\n- kind: bar\n  ends: [1, 2, 3]\n", 4, "parts.0.ends", "list of 3", "at most 2 items", ""),
        ("name: a\nparts:\n- kind: bar\n  ends: [1, x]\n", 4, "parts.0.ends.1", "'x'", "a number", ""),
        ("name: a\nparts: 3", 2, "parts", "the number 3", "a list", ""),
        ("name: a\nfriction: {go-gound: 1}", 2, "friction.go-gound", "unknown key", "one of go-eo", "go-ground"),
        ("name: a\nmaybe:\n  kind: ball\n  radius: x", 4, "maybe.radius", "'x'", "a number", ""),
        ("name: a\nmaybe: 3", 2, "maybe", "the number 3", "a mapping", ""),
        ("name: a\nnamed:\n  x:\n    kind: ball\n    radius: -1", 5, "named.x.radius", "-1", "greater than 0", ""),
    ],
)
def test_each_fault_says_where_what_and_what_was_expected(text, line, key, wrong, expected, nearest):
    found = problem(text)
    assert (found.file, found.line, found.key) == ("thing.yaml", line, key)
    assert wrong in found.wrong
    assert expected in found.expected
    assert found.nearest == nearest


def test_every_fault_is_reported_at_once_in_the_order_of_lines():
    with pytest.raises(InputError) as e:
        parse(Thing, read_text("mass: -1\ncolour: blue\nextra: 1\n", "x"))
    assert {p.key for p in e.value.problems} == {"name", "mass", "colour", "extra"}
    lines = [p.line or 0 for p in e.value.problems]
    assert lines == sorted(lines)


# -- --set -----------------------------------------------------------------------------------------------------------


def test_set_replaces_adds_and_reaches_into_lists():
    document = read_text("name: a\nparts: [{kind: bar}]\n", "x")
    thing = parse(
        Thing, document, {"mass": "1e-3", "parts.0.ends": "[2, 3]", "maybe.kind": "ball", "maybe.radius": "1"}
    )
    assert thing.mass == 0.001
    assert thing.parts == (Bar(kind="bar", ends=(2, 3)),)
    assert thing.maybe == Ball(kind="ball", radius=1)
    assert document.data == {"name": "a", "parts": [{"kind": "bar"}]}


def test_a_bad_set_value_is_reported_at_the_option():
    with pytest.raises(InputError) as e:
        parse(Thing, read_text("name: a\nmass: 1\n", "x"), {"mass": "-2"})
    assert str(e.value).startswith("--set mass: the number -2\n    expected: greater than 0")


def test_a_fault_inside_a_set_mapping_is_reported_at_the_option():
    with pytest.raises(InputError) as e:
        parse(Thing, read_text("name: a\n", "x"), {"maybe": "{kind: ball, radios: 1}"})
    assert {(p.file, p.key) for p in e.value.problems} == {
        ("--set maybe", "maybe.radios"),
        ("--set maybe", "maybe.radius"),
    }


@pytest.mark.parametrize(
    ("key", "value", "says"),
    [
        ("parts.3.kind", "bar", "no item '3'"),
        ("parts.x.kind", "bar", "no item 'x'"),
        ("name.first", "x", "text 'a'"),
        ("a..b", "1", "empty name"),
        ("mass", "{a", "not YAML"),
        ("mass", "a: b: c", "not YAML"),
        ("mass", "!!int 3", "tag"),
        ("mass", ".nan", "not finite"),
    ],
)
def test_a_set_that_cannot_be_applied_names_the_option(key, value, says):
    with pytest.raises(InputError) as e:
        set_key(read_text("name: a\nparts: [{kind: bar}]\n", "x"), key, value)
    assert e.value.problems[0].file == f"--set {key}"
    assert says in e.value.problems[0].wrong


@settings(deadline=None)
@given(st.lists(st.sampled_from(["parts", "0", "1", "kind", "name", "x", "maybe", "-1", "²", "radius"]), min_size=1))
def test_set_finds_its_place_or_refuses(path):
    document = read_text("name: a\nparts: [{kind: bar}]\n", "x")
    try:
        changed: Any = set_key(document, ".".join(path), "7").data
    except InputError:
        return
    for key in path:
        changed = changed[int(key)] if isinstance(changed, list) else changed[key]
    assert changed == 7


def test_a_path_exists_by_the_model_whether_or_not_the_file_has_it():
    data = {"name": "a", "parts": [{"kind": "bar"}], "named": {"x": {}}}
    for path in ("mass", "parts.0.ends", "parts.0.ends", "friction.go-eo", "maybe.radius", "named.x.radius"):
        assert model_paths.exists(Thing, path.split("."), data), path
    for path in (
        "mas",
        "parts.0.radius",
        "parts.1.kind",
        "friction.go-gound",
        "maybe.ends",
        "named.y.radius",
        "name.x",
    ):
        assert not model_paths.exists(Thing, path.split("."), data), path


# -- names -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def shelf(tmp_path, monkeypatch):
    here, shelf = tmp_path / "here", tmp_path / "shelf"
    (here / "own").mkdir(parents=True)
    shelf.mkdir()
    for name in ("pentagon", "heptagon"):
        (shelf / f"{name}.yaml").write_text("a: 1")
    (here / "own" / "mine.yaml").write_text("a: 1")
    monkeypatch.chdir(here)
    return shelf


def test_a_bare_name_means_the_shipped_file_and_a_path_its_own(shelf):
    assert locate("pentagon", "object", [shelf]) == shelf / "pentagon.yaml"
    assert locate("own/mine.yaml", "object", [shelf]).read_text() == "a: 1"
    assert locate("own/mine", "object", [shelf]).name == "mine.yaml"


def test_the_current_folder_comes_first(shelf, tmp_path):
    (tmp_path / "here" / "pentagon.yaml").write_text("b: 2")
    assert locate("pentagon", "object", [shelf]).read_text() == "b: 2"


def test_an_unknown_name_lists_what_exists_and_the_nearest(shelf):
    with pytest.raises(InputError) as e:
        locate("pentagn", "object", [shelf])
    found = e.value.problems[0]
    assert (found.file, found.nearest) == ("pentagn", "pentagon")
    assert found.expected == "a path, or one of heptagon, pentagon"
    assert "no such object" in found.wrong


@pytest.mark.parametrize("name", ["", "own", "a\0b", "x" * 5000, "..", "/", "~nobody_of_that_name/x"])
def test_a_name_that_is_no_file_is_refused_as_input(shelf, name):
    with pytest.raises(InputError):
        locate(name, "object", [shelf])
