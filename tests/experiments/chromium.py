"""A browser that looks at pages; who has none has the tests of pages skipped."""

import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

PATH = shutil.which("chromium") or "/usr/bin/chromium"


@contextmanager
def launched(*arguments: str) -> Iterator[Any]:
    """Chromium without a window, quiet by itself, with more ``arguments``."""
    sync_api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    # `make` installs it where it may; elsewhere a system package of 300 MB must not keep the other tests from running
    if not Path(PATH).exists():
        pytest.skip(f"no chromium at {PATH}; on Debian: apt-get install chromium")
    quiet = ["--no-sandbox", "--disable-background-networking", "--no-first-run"]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=PATH, args=[*quiet, *arguments])
        yield browser
        browser.close()


@contextmanager
def opener(browser: Any) -> Iterator[Callable[..., Any]]:
    """What opens pages from disk, off line: ``open(path, width=1280, scheme="light")``, each in a window of its own.

    What a page complains of and asks for is in its ``heard``; a picture whose bytes stand in the page is no request.
    """
    contexts = []

    def open_page(path: Path, width: int = 1280, scheme: str = "light") -> Any:
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=scheme, offline=True)
        context.set_default_timeout(30_000)
        contexts.append(context)
        page = context.new_page()
        page.heard = []
        page.on("console", lambda message: page.heard.append(f"{message.type}: {message.text}"))
        page.on("pageerror", lambda error: page.heard.append(f"error: {error}"))
        own = (path.as_uri(), "data:image/")
        page.on("request", lambda request: request.url.startswith(own) or page.heard.append(f"request: {request.url}"))
        page.goto(path.as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()


def assert_quiet_and_within(page: Any, width: int) -> None:
    """Nothing was complained of or asked for, and neither the page nor a table in it has to be pushed sideways."""
    assert page.heard == []
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    for table in page.locator(".scroll").all():
        assert table.evaluate("box => box.scrollWidth - box.clientWidth") <= 1, table.inner_text()
