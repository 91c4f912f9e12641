"""Tags in pictures of real cameras: the turntable's labels, and the corners that the reference detector gave.

`test_tags.py` looks at the same pictures for what refinement and search do to them.
"""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest
from ruamel.yaml import YAML

from drivers.tags import TagDetector
from tests.recordings import recording

LABELS = 3.5  # degrees; as well as a person set the tag


def grey(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return np.asarray(image, np.uint8)


@pytest.fixture(scope="module")
def turned() -> tuple[dict[int, np.ndarray], np.ndarray, float]:
    """Corners (4, 2) of the tag by the angle it was set to [deg], the camera's K, the tag's size [m]."""
    folder = recording("apriltag_rotation")
    info = YAML(typ="safe").load(folder / "test_info.yaml")["rotation_test"]
    out = {}
    for path in sorted(folder.glob("test_image_rotation_*.png")):
        (tag,) = TagDetector().detect(grey(path))
        assert tag.id == 76
        out[int(path.stem.rsplit("_", 1)[1])] = tag.corners
    assert len(out) >= 7
    return out, np.array(info["K"]).reshape(3, 3), info["tag_size"]


def test_a_tag_on_a_turntable_turned_by_its_labels_about_one_axis_and_one_way(turned) -> None:
    corners, K, size = turned
    square = 0.5 * size * np.array([(-1.0, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
    R = {}
    for label, pixels in corners.items():
        found, turn, _ = cv2.solvePnP(square, pixels, K, np.zeros(5), flags=cv2.SOLVEPNP_ITERATIVE)
        assert found
        R[label] = cv2.Rodrigues(turn)[0]
    turns = {label: cv2.Rodrigues(R[0].T @ R[label])[0].ravel() for label in R if label}
    axis = np.sum([np.sign(label) * turn for label, turn in turns.items()], axis=0)
    axis /= np.linalg.norm(axis)
    for label, turn in turns.items():
        assert np.degrees(turn @ axis) == pytest.approx(label, abs=LABELS)  # with its sign
        assert np.degrees(np.linalg.norm(turn - (turn @ axis) * axis)) < LABELS


def golden(path: Path) -> list[tuple[int, np.ndarray]]:
    """Ids and corners (4, 2) of the reference detector, whose pixel centres lie at halves."""
    rows = [[float(v) for v in re.findall(r"[-\d.]+", line)] for line in path.read_text().splitlines()]
    return [(int(row[0]), np.array(row[1:]).reshape(4, 2) - 0.5) for row in rows if len(row) == 9]


@pytest.mark.parametrize(("photo", "seen"), [("33369213973_9d9bb4cc96_c", 12), ("34085369442_304b6bafd9_c", 24)])
def test_every_tag_of_a_photograph_is_where_the_reference_detector_has_one(photo: str, seen: int) -> None:
    photographs = recording("apriltag_umich")
    expected = golden(photographs / f"{photo}.txt")
    # the reference took its corners before any refinement
    found = TagDetector(decimate=1, refine=False, max_hamming=2).detect(grey(photographs / f"{photo}.jpg"))
    near = [
        min((np.abs(tag.corners - corners).max() for id, corners in expected if id == tag.id), default=np.inf)
        for tag in found
    ]
    assert max(near) < 0.2  # px; no false one, and none is off
    assert len(found) >= seen
