"""The site of docs/, built once."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="session")
def site(tmp_path_factory):
    """The folder of the built site: warnings are errors, so every link between pages and to their headings holds."""
    folder = tmp_path_factory.mktemp("site")
    options = ["-W", "--keep-going", "-q", "-n", "-d", folder / "trees"]
    build = [sys.executable, "-m", "sphinx", *options, "docs", folder / "html"]
    made = subprocess.run(build, cwd=ROOT, capture_output=True, text=True, timeout=110, check=False)
    assert made.returncode == 0, made.stderr
    return folder / "html"
