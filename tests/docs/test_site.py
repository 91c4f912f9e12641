"""The site of docs/: complete, its links hold, and it asks nobody for anything."""

import re
from html.parser import HTMLParser
from urllib.parse import unquote, urlsplit

import pytest

from experiments import yaml_reference
from tests.docs.conftest import ROOT

DOCS = ROOT / "docs"
#: what a page loads by itself, as against what a reader may follow
LOADED = {("script", "src"), ("img", "src"), ("link", "href"), ("iframe", "src"), ("source", "src"), ("image", "href")}


class Links(HTMLParser):
    """Every address of a page, with the element it stands in, and the places in it that can be linked to."""

    def __init__(self, path):
        super().__init__()
        self.found, self.places = [], set()
        self.feed(path.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name in ("href", "src") and value:
                self.found.append((tag, name, value))
            if name == "id":
                self.places.add(value)


@pytest.fixture(scope="module")
def pages(site):
    return {path: Links(path) for path in sorted(site.rglob("*.html"))}


def test_every_page_of_the_docs_is_there(site):
    sources = [path.relative_to(DOCS) for path in DOCS.rglob("*.md")]
    assert len(sources) > 25
    assert [str(path) for path in sources if not (site / path.with_suffix(".html")).is_file()] == []


def test_nothing_is_loaded_from_elsewhere(pages, site):
    loaded = [value for page in pages.values() for tag, name, value in page.found if (tag, name) in LOADED]
    assert len(loaded) > 100
    assert [value for value in loaded if urlsplit(value).netloc] == []
    styles = "".join(path.read_text(encoding="utf-8") for path in site.rglob("*.css"))
    assert re.findall(r"(?:url\(|@import)\s*['\"]?(?:https?:)?//[^)'\"]+", styles) == []


def test_every_link_within_the_site_leads_somewhere(pages):
    broken = []
    for path, page in pages.items():
        for _, _, value in page.found:
            parts = urlsplit(value)
            if parts.scheme or parts.netloc:
                continue
            target = (path.parent / unquote(parts.path)).resolve() if parts.path else path
            places = pages[target].places if target in pages else set()
            if not target.is_file() or (parts.fragment and unquote(parts.fragment) not in places):
                broken.append((path.name, value))
    assert broken == []


def test_what_the_readme_and_the_changelog_link_to_is_there():
    for name in ("README.md", "CHANGELOG.md"):
        text = (ROOT / name).read_text(encoding="utf-8")
        local = [link for link in re.findall(r"\]\(([^)\s]+)\)", text) if not urlsplit(link).scheme]
        assert local, name
        assert [link for link in local if not (ROOT / link.partition("#")[0]).exists()] == []


def test_the_home_page_leads_to_every_page(pages, site):
    home = pages[site / "index.html"]
    reached = {(site / urlsplit(value).path).resolve() for tag, _, value in home.found if tag == "a"}
    asked = {(site / path.relative_to(DOCS).with_suffix(".html")).resolve() for path in DOCS.rglob("*.md")}
    assert {path.name for path in asked - reached} <= {"index.html"}


@pytest.mark.parametrize("kind", [name for name, _ in yaml_reference.pages()])
def test_the_yaml_reference_is_that_of_the_models(kind):
    page = DOCS / "yaml" / f"{kind}.md"
    assert page.read_text(encoding="utf-8") == dict(yaml_reference.pages())[kind], (
        "python -m experiments.yaml_reference docs/yaml writes it anew"
    )


@pytest.mark.parametrize("kind", [name for name, _ in yaml_reference.pages()])
def test_every_key_that_a_schema_has_is_in_its_page(kind):
    from experiments.editors import KINDS

    page = (DOCS / "yaml" / f"{kind}.md").read_text(encoding="utf-8")
    told = set(re.findall(r"^\| `([^`]+)` \|", page, re.MULTILINE))

    def keys(node):
        if isinstance(node, list):
            for item in node:
                yield from keys(item)
        elif isinstance(node, dict):
            for name, value in node.items():
                if name == "properties":
                    yield from value
                if name not in ("default", "const", "enum", "if"):
                    yield from keys(value.values() if name in ("properties", "definitions") else value)

    schema = KINDS[kind]()
    asked = set(keys(schema)) if kind != "experiment" else set(keys(schema["definitions"]["Experiment"]))
    assert asked <= told


def test_the_figures_are_drawn_by_the_code(tmp_path):
    """Each figure that the docs show is one that docs/figures.py draws, and it draws what is shown."""
    import importlib.util

    spec = importlib.util.spec_from_file_location("figures", DOCS / "figures.py")
    assert spec is not None and spec.loader is not None
    figures = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(figures)
    figures.main(tmp_path)
    shown = set(re.findall(r"\(images/concepts/(\w+)\.svg\)", (DOCS / "concepts.md").read_text(encoding="utf-8")))
    assert shown == set(figures.FIGURES)
    for name in shown:
        drawn, kept = (coordinates(folder / f"{name}.svg") for folder in (tmp_path, DOCS / "images" / "concepts"))
        assert len(drawn) == len(kept), f"{name}: `make docs` draws it anew"
        assert max(abs(a - b) for a, b in zip(drawn, kept, strict=True)) < 0.5, f"{name}: `make docs` draws it anew"


def coordinates(path):
    """The numbers of a drawing's paths, in points."""
    return [
        float(number)
        for line in re.findall(r'\sd="([^"]+)"', path.read_text(encoding="utf-8"))
        for number in re.findall(r"-?\d+\.?\d*", line)
    ]
