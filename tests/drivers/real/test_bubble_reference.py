"""The picture of a Soft Bubble that nothing touches."""

import cv2
import numpy as np
import pytest

from drivers.errors import CommandRefused
from tests.drivers.real.bubbles import HEIGHT, LENS, WIDTH, bubble, dome, record


def test_the_reference_is_the_mean_of_what_is_there(still):
    with bubble(recording=str(still), loop=True, reference="take") as finger:
        reference = finger.reference()
        np.testing.assert_array_equal(finger.reference(), reference)
    bare = dome(WIDTH, HEIGHT, LENS)
    inside = bare > 0
    inside[100, [100, 110]] = False
    np.testing.assert_array_equal(reference[inside], bare[inside] + 1)  # half of the pictures have 2 more
    assert reference[100, 110] == 900 and reference[100, 100] == 0  # seen in two thirds of them, and in one
    assert reference.dtype == np.uint16


def test_a_reference_is_kept_in_a_file_and_read_from_it(still, tmp_path):
    file = tmp_path / "new" / "reference.png"
    with bubble(recording=str(still), loop=True) as finger:
        taken = finger.take_reference(frames=6, file=file)
    assert [path.name for path in file.parent.iterdir()] == ["reference.png"]
    with bubble(recording=str(still), loop=True, reference=str(file)) as finger:
        np.testing.assert_array_equal(finger.reference(), taken)


def test_a_reference_of_what_moves_is_refused(numbers):
    with (
        bubble(recording=str(numbers), loop=True) as finger,
        pytest.raises(CommandRefused, match="of the picture ch"),
    ):
        finger.take_reference(frames=12)


def test_a_reference_of_what_is_not_seen_is_refused(rs, tmp_path):
    file = record(tmp_path / "dark.db3", [np.zeros((HEIGHT, WIDTH), np.uint16)] * 10)
    with bubble(recording=str(file), loop=True) as finger, pytest.raises(CommandRefused, match="0% of its pixels only"):
        finger.take_reference(frames=4)


@pytest.mark.parametrize(
    "written", [None, b"nothing", np.zeros((10, 10), np.uint16), np.zeros((HEIGHT, WIDTH), np.uint8)]
)
def test_a_file_that_is_no_reference_is_refused_with_its_name(still, tmp_path, written):
    file = tmp_path / "reference.png"
    if isinstance(written, bytes):
        file.write_bytes(written)
    elif written is not None:
        cv2.imwrite(str(file), written)
    finger = bubble(recording=str(still), loop=True, reference=str(file))
    with finger, pytest.raises(CommandRefused, match=f"{file}.*check-device"):
        finger.reference()


def test_without_a_reference_it_says_how_to_take_one(still):
    with (
        bubble(recording=str(still), loop=True) as finger,
        pytest.raises(CommandRefused, match=r"there is none\..*takes one"),
    ):
        finger.reference()
