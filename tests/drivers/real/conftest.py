"""Recordings of a depth camera."""

import numpy as np
import pytest

from tests.drivers.real.bubbles import COUNT, HEIGHT, LENS, MISSING, WIDTH, dome, numbered, record


@pytest.fixture(scope="session")
def rs():
    return pytest.importorskip("pyrealsense2", exc_type=ImportError, reason="pyrealsense2, or libusb, is not installed")


@pytest.fixture(scope="session")
def numbers(rs, tmp_path_factory):
    """Pictures 1 to 20 without the 7th and 8th."""
    file = tmp_path_factory.mktemp("bubble") / "numbered.db3"
    return record(file, [numbered(n) for n in range(1, COUNT + 1)], missing=MISSING)


@pytest.fixture(scope="session")
def still(rs, tmp_path_factory):
    """The untouched dome; a pixel that has a depth in every other picture but one, and one that has it more often."""
    pictures = [dome(WIDTH, HEIGHT, LENS) + np.uint16(2 * (n % 2)) for n in range(40)]
    for n, picture in enumerate(pictures):
        picture[picture <= 2] = 0
        picture[100, 100] = 900 if n % 3 == 0 else 0
        picture[100, 110] = 900 if n % 3 else 0
    return record(tmp_path_factory.mktemp("bubble") / "still.db3", pictures)
