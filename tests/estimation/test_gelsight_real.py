"""Pictures of real gels: edges by hand labels, contact blobs, dots. Skipped where the recordings are absent."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from estimation.gel_deformation import GelReference, deformation
from estimation.gel_markers import find_dots
from estimation.gel_straight_edges import StraightEdge, straight_edges
from estimation.tactile_pose import PoseStatus
from tests.recordings import DATA, recorded

gelslim_data, gelsight_data = recorded("gelslim"), recorded("gelsight_edges")
PRESSES = (3, 4, 5, 6, 7, 8, 9, 10, 13, 14, 15, 17)


def read(path: Path) -> np.ndarray:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image, np.uint8)


@pytest.fixture(scope="module")
def found() -> list[StraightEdge]:
    """The clearest edge of each frame."""
    folder = DATA / "gelsight_edges"
    reference = GelReference.of(read(folder / "background.png"))
    edges = [straight_edges(read(folder / str(k) / "gelsight.png"), reference, most=1) for k in range(11)]
    assert all(edges), "a frame without an edge"
    return [many[0] for many in edges]


@gelsight_data
def test_the_clearest_edge_is_the_one_that_was_labelled_by_hand(found: list[StraightEdge]) -> None:
    """Steps of the labels: 1° and 2 px. Distances are of the found line, and of its middle, from the label's centre."""
    errors = []
    for k, edge in enumerate(found):
        label = np.load(DATA / "gelsight_edges" / str(k) / "label.npz")
        turned = (np.degrees(edge.angle) - float(label["line_angle"]) + 90) % 180 - 90
        off = edge.centre - label["line_center"]
        errors.append((turned, off @ (-np.sin(edge.angle), np.cos(edge.angle)), np.linalg.norm(off)))
    angle, across, centre = np.abs(errors).T
    assert angle.max() < 2
    assert across.max() < 4
    assert centre.max() < 4
    assert np.median(angle) < 1
    assert np.median(across) < 2
    assert np.median(centre) < 2


@gelsight_data
def test_its_length_is_that_of_the_cube(found: list[StraightEdge]) -> None:
    """10 mm at 0.0634 mm per pixel: 158 px."""
    lengths = np.array([edge.length for edge in found])
    assert np.median(lengths) == pytest.approx(158, abs=6)
    assert np.abs(lengths - 158).max() < 13


@gelslim_data
@pytest.mark.parametrize("sample", PRESSES)
def test_a_pressed_ball_is_one_roundish_blob(sample: int) -> None:
    folder = DATA / "gelslim"
    found = deformation(read(folder / "press" / f"sample_{sample}.jpg"), GelReference.of(read(folder / "ref.jpg")))
    assert found.status is PoseStatus.OK
    blobs = found.blobs()
    assert len(blobs) == 1
    area = float(blobs[0].sum())
    # a ball of 3.8 mm at 0.106 mm per pixel has a section of 4055 px; with the wall around it, up to some 10 000
    assert 2000 < area < 12000
    (_, (width, height), _) = cv2.minAreaRect(np.argwhere(blobs[0]).astype(np.float32))
    assert max(width, height) / min(width, height) < 1.6
    assert area / (width * height) > 0.6


@gelslim_data
def test_a_gel_that_nothing_touches_has_no_contact() -> None:
    folder = DATA / "gelslim"
    found = deformation(read(folder / "objects" / "reconstruct_0.jpg"), GelReference.of(read(folder / "ref.jpg")))
    assert found.status is PoseStatus.NO_CONTACT
    assert found.blobs() == []
    assert found.noise < 5


@gelslim_data
@pytest.mark.parametrize("thing", [1, 2])
def test_other_objects_are_one_contact(thing: int) -> None:
    folder = DATA / "gelslim"
    image = read(folder / "objects" / f"reconstruct_{thing}.jpg")
    found = deformation(image, GelReference.of(read(folder / "ref.jpg")))
    assert found.status is PoseStatus.OK
    assert len(found.blobs()) == 1


@gelslim_data
def test_dots_of_a_real_gel_are_found_again_to_a_tenth_of_a_pixel() -> None:
    """Between two pictures of the untouched gel it has crept a little, smoothly: what a quartic leaves is ours."""
    folder = DATA / "gelslim"
    rest = find_dots(read(folder / "ref.jpg")).centres
    again = find_dots(read(folder / "objects" / "reconstruct_0.jpg")).centres
    gap = np.linalg.norm(rest[:, None] - again, axis=2)
    same = gap.min(axis=1) < 4
    assert len(rest) > 220
    assert same.mean() > 0.97
    moved = (again[gap.argmin(axis=1)] - rest)[same]
    x, y = ((rest[same] - rest.mean(axis=0)) / 200).T
    A = np.stack([x**i * y**j for i in range(5) for j in range(5 - i)], axis=-1)
    left = moved - A @ np.linalg.lstsq(A, moved, rcond=None)[0]
    assert left.std(axis=0).max() < 0.2


@gelslim_data
def test_a_pressed_ball_pushes_the_dots_around_it_outward() -> None:
    folder = DATA / "gelslim"
    reference = GelReference.of(read(folder / "ref.jpg"))
    outward = []
    for sample in PRESSES:
        found = deformation(read(folder / "press" / f"sample_{sample}.jpg"), reference)
        away = reference.dots.centres - np.argwhere(found.blobs()[0]).mean(axis=0)[::-1]
        far = np.linalg.norm(away, axis=1)
        gap = np.linalg.norm(reference.dots.centres[:, None] - found.dots.centres, axis=2)
        moved = found.dots.centres[gap.argmin(axis=1)] - reference.dots.centres
        ring = (far > 50) & (far < 90) & (gap.min(axis=1) < 5)
        outward.append(float(np.median((moved * away).sum(axis=1)[ring] / far[ring])))
    assert np.median(outward) > 0.2
    assert min(outward) > 0


@gelsight_data
def test_a_gel_without_dots_has_none() -> None:
    assert len(find_dots(read(DATA / "gelsight_edges" / "background.png"))) == 0
