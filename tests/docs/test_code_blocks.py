"""The code blocks of README and docs: Python runs, YAML is what the loader takes, and commands are those there are.

The blocks of the how-tos (`docs/add-*.md`) are followed as they stand by tests of their own.
"""

import io
import json
import re
import shlex
from pathlib import Path
from typing import Any

import jsonschema
import pytest
import typer
from ruamel.yaml import YAML
from typer.main import get_command

from experiments.cli import app
from experiments.editors import KINDS
from tests.docs.conftest import ROOT

PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]
FENCE = re.compile(r"^```(\w+)\n(.*?)^```$", re.MULTILINE | re.DOTALL)
BLOCKS = [
    (page.relative_to(ROOT).as_posix(), *found.groups(), text[: found.start()].count("\n") + 1)
    for page in PAGES
    for text in [page.read_text(encoding="utf-8")]
    for found in FENCE.finditer(text)
]
#: what the parser of the command line raises
UsageError: Any = typer.BadParameter.__base__
#: of which kind a page's YAML is, where it is not an experiment's
KIND = {"docs/security.md": "station", "docs/deploy.md": "station", "docs/tables.md": "table"}


def blocks(language):
    return [
        pytest.param(page, text, id=f"{page}:{line}")
        for page, said, text, line in BLOCKS
        if said == language and not Path(page).name.startswith("add-")
    ]


def test_every_block_is_of_a_language_that_is_checked():
    checked = {"python", "yaml", "sh", "json"}
    followed = {"toml", "text"}  # files, and what commands print: compared where a how-to is followed
    for page, language, _, line in BLOCKS:
        assert language in (checked | followed if Path(page).name.startswith("add-") else checked), f"{page}:{line}"
    assert len(BLOCKS) >= 50


@pytest.mark.parametrize(("page", "text"), blocks("json"))
def test_json_is_json(page, text):
    assert json.loads(text), page


# -- commands ----------------------------------------------------------------------------------------------------------


def commands(text):
    """The calls of `extrinsic` in a shell block, comments and what surrounds them left out."""
    for line in text.replace("\\\n", " ").splitlines():
        for part in re.split(r"&&|\|\||;", line):
            words = shlex.split(part, comments=True)
            if words[:2] == ["sudo", "-u"]:
                words = words[3:]
            if words and Path(words[0]).name == "extrinsic":
                yield words[1:]


def parsed(words):
    """Parse a call as the command would, without running it."""
    command: Any = get_command(app)
    context = typer.Context(command, info_name="extrinsic")
    while hasattr(command, "commands") and words and not words[0].startswith("-"):
        name, *words = words
        found = command.get_command(context, name)
        assert found is not None, f"there is no command `{name}`"
        command, context = found, typer.Context(found, info_name=name, parent=context)
    if words != ["--install-completion"]:  # typer's own, which would install it
        command.make_context(context.info_name, [word for word in words if word not in ("[NAME", "...]")])


@pytest.mark.parametrize(("page", "text"), blocks("sh"))
def test_commands_are_written_as_the_command_takes_them(page, text):
    for words in commands(text):
        try:
            parsed(words)
        except UsageError as error:
            pytest.fail(f"{page}: extrinsic {shlex.join(words)}: {error.format_message()}")


def test_a_command_that_does_not_exist_would_be_found():
    with pytest.raises(AssertionError, match="there is no command"):
        parsed(["fly", "home"])
    with pytest.raises(UsageError):
        parsed(["run", "demo", "--fast"])


@pytest.mark.parametrize(("page", "text"), blocks("sh"))
def test_files_that_commands_name_by_their_path_in_the_checkout_are_there(page, text):
    for path in re.findall(r"(?<![\w/])(?:tests|experiments|docs)/[\w./-]+\.\w+", text):
        assert (ROOT / path).exists(), f"{page}: {path}"


# -- YAML --------------------------------------------------------------------------------------------------------------


def lenient(schema: Any) -> Any:
    """A schema whose keys are checked wherever they stand, and none of which is needed: for an excerpt of a file."""
    if isinstance(schema, list):
        return [lenient(one) for one in schema]
    if not isinstance(schema, dict):
        return schema
    return {key: value if key == "if" else lenient(value) for key, value in schema.items() if key != "required"}


@pytest.mark.parametrize(("page", "text"), blocks("yaml"))
def test_yaml_is_what_the_loader_takes(page, text):
    document = YAML(typ="safe").load(io.StringIO(text))
    if document is None:  # a comment alone
        assert text.lstrip().startswith("#")
        return
    if isinstance(document, list):
        document = {"stages": document}
    schema = KINDS[KIND.get(page, "experiment")]()
    if "else" in schema:
        schema = {"definitions": schema["definitions"], **schema["else"]}
    whole = isinstance(document, dict) and {"name", "stages"} <= set(document)
    jsonschema.Draft7Validator(schema if whole else lenient(schema)).validate(document)


def test_an_excerpt_with_a_misspelt_key_would_be_found():
    schema = lenient(KINDS["station"]())
    with pytest.raises(jsonschema.ValidationError, match="endpiont"):
        jsonschema.Draft7Validator(schema).validate({"bus": {"endpiont": "tcp/127.0.0.1:7447"}})


# -- Python ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("page", "text"), blocks("python"))
def test_python_runs(page, text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    exec(compile(text, page, "exec"), {"__name__": "__main__"})
