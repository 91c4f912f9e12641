"""A browser that looks at pages; who has none has the tests of pages skipped."""

import shutil
from collections.abc import Iterator
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
