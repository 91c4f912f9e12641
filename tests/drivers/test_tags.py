import re
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from ruamel.yaml import YAML

from drivers.errors import NotConnected
from drivers.tags import TagDetector, refine_corners, regions_around, tag_bitmap
from tests.recordings import recording

ROOT = Path(__file__).parents[2]


def photograph(path: Path) -> np.ndarray:
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    return np.asarray(image, np.uint8)


def picture(*placed: tuple[int, int, int], cell: int = 12, shape: tuple[int, int] = (240, 420)) -> np.ndarray:
    """Grey picture of upright tags (id, x, y): the black square's outer edge starts at pixel column x and row y."""
    image = np.full(shape, 128, np.uint8)
    for id, x, y in placed:
        tag = np.kron(tag_bitmap(id), np.ones((cell, cell), np.uint8))
        image[y - cell : y + 9 * cell, x - cell : x + 9 * cell] = tag
    return image


def square(x: int, y: int, side: int) -> np.ndarray:
    """Corners of a square of pixels that starts at column x, row y; its edges lie half a pixel before pixel centres."""
    left, top = x - 0.5, y - 0.5
    return np.array(
        [(left, top + side), (left + side, top + side), (left + side, top), (left, top)]
    )  # (−,−) is lower left


@pytest.mark.parametrize("family", ["tag36h11", "tag25h9", "tag16h5"])
def test_an_upright_tag_is_seen_upright_with_corners_from_lower_left(family: str) -> None:
    cells = tag_bitmap(3, family)
    image = np.pad(np.kron(cells, np.ones((16, 16), np.uint8)), 50, constant_values=128)
    with_family = TagDetector(family)
    (tag,) = with_family.detect(image)
    assert (tag.id, tag.hamming) == (3, 0)
    np.testing.assert_allclose(tag.corners, square(66, 66, 16 * (len(cells) - 2)), atol=0.01)


@pytest.mark.parametrize("decimate", [1.0, 2.0])
def test_pixel_centres_lie_at_integers(decimate: float) -> None:
    detections = TagDetector(decimate=decimate).detect(picture((7, 51, 60), (2, 240, 93)))
    assert [d.id for d in detections] == [2, 7]
    np.testing.assert_allclose(detections[0].corners, square(240, 93, 96), atol=0.01)
    np.testing.assert_allclose(detections[1].corners, square(51, 60, 96), atol=0.01)


def test_corners_turn_with_the_tag() -> None:
    (tag,) = TagDetector().detect(np.ascontiguousarray(np.rot90(picture((5, 60, 60), shape=(220, 220)))))
    turned = square(60, 60, 96) @ [[0, -1], [1, 0]] + (0, 219)  # 90° counter-clockwise as seen: (x, y) -> (y, 219 - x)
    np.testing.assert_allclose(tag.corners, turned, atol=0.01)


def blurred(image: np.ndarray) -> np.ndarray:
    return cv2.GaussianBlur(image, (0, 0), 1.2)


def lit_from_the_left(image: np.ndarray) -> np.ndarray:
    return (image * np.linspace(1.0, 0.45, image.shape[1])).astype(np.uint8)


def soiled(image: np.ndarray) -> np.ndarray:
    image = image.copy()
    image[100:118, 48:60] = 60  # a smear on a fifth of the left margin, up to the edge
    return image


@pytest.mark.parametrize("spoil", [blurred, lit_from_the_left, soiled])
def test_refined_corners_stand_what_real_pictures_have(spoil) -> None:
    rough = square(60, 60, 96) + np.random.default_rng(0).uniform(-1, 1, (4, 2))
    (corners,) = refine_corners(spoil(picture((9, 60, 60))), rough[None])
    np.testing.assert_allclose(corners, square(60, 60, 96), atol=0.03)


def slanted(rng: np.random.Generator, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """A tag in a general homography, each pixel the mean of 8 × 8 samples, and its true corners."""
    true = square(60, 60, 96) + rng.uniform(-14, 14, (4, 2))
    unit = np.array([(-4, 4), (4, 4), (4, -4), (-4, -4)], np.float32)  # cells, y down
    H = cv2.getPerspectiveTransform(true.astype(np.float32), unit)
    n = 8
    fine = (np.arange(220 * n) + 0.5) / n - 0.5
    grid = np.stack(np.meshgrid(fine, fine), axis=-1).reshape(1, -1, 2)
    cell = np.floor(cv2.perspectiveTransform(grid, H)[0] + 5).astype(int)
    on = ((cell >= 0) & (cell < 10)).all(axis=1)
    cell = np.clip(cell, 0, 9)
    grey = np.where(on, 30 + 0.8 * tag_bitmap(11)[cell[:, 1], cell[:, 0]], 128.0)
    image = grey.reshape(220, n, 220, n).mean(axis=(1, 3)) + rng.normal(0, noise, (220, 220))
    return np.clip(np.rint(image), 0, 255).astype(np.uint8), true


@pytest.mark.parametrize(("noise", "bound", "gain"), [(0.0, 0.005, 10), (4.0, 0.015, 3)])
def test_refinement_brings_corners_to_a_hundredth_of_a_pixel(noise: float, bound: float, gain: float) -> None:
    rng = np.random.default_rng(3)
    rough, fine = TagDetector(refine=False), TagDetector()
    errors = {"rough": [], "fine": []}
    for _ in range(6):
        image, true = slanted(rng, noise)
        errors["rough"].append(rough.detect(image)[0].corners - true)
        errors["fine"].append(fine.detect(image)[0].corners - true)
    rms = {name: np.sqrt(np.mean(np.square(e))) for name, e in errors.items()}
    assert rms["fine"] < bound
    assert gain * rms["fine"] < rms["rough"]


def test_a_tag_too_small_to_refine_keeps_its_corners() -> None:
    small = np.array([[[10.3, 25.0], [25.0, 25.2], [25.0, 10.0], [10.0, 10.0]]])
    np.testing.assert_array_equal(refine_corners(np.full((40, 40), 128, np.uint8), small), small)


def test_edges_that_are_not_there_leave_the_corners_alone() -> None:
    rough = square(60, 60, 96)[None]
    np.testing.assert_array_equal(refine_corners(np.full((220, 220), 128, np.uint8), rough), rough)


def test_only_the_regions_asked_for_are_searched() -> None:
    image = picture((7, 51, 60), (2, 240, 93))
    detector = TagDetector()
    both = detector.detect(image)
    (tag,) = detector.detect(image, regions=[(0, 0, 180, 240)])
    assert tag.id == 7
    np.testing.assert_allclose(tag.corners, both[1].corners, atol=1e-3)
    twice = detector.detect(image, regions=[(0, 0, 180, 240), (-20, -20, 190, 300), *regions_around(both)])
    assert [d.id for d in twice] == [2, 7]
    assert detector.detect(image, regions=[]) == ()
    assert detector.detect(image, regions=[(500, 500, 600, 600), (3, 3, 9, 9)]) == ()


def test_tracking_finds_a_tag_near_where_it_was_and_one_that_has_jumped_away() -> None:
    detector = TagDetector()
    for columns in (51, 60, 200, 51):
        tags = (7, columns, 60), (2, 320, 93)
        found = detector.track(picture(*tags, shape=(240, 480)), {7, 2})
        assert [d.id for d in found] == [2, 7]
        np.testing.assert_allclose(found[1].corners, square(columns, 60, 96), atol=0.01)


def test_tracking_sees_a_tag_that_comes_into_view_later_or_comes_back() -> None:
    both, one = picture((7, 51, 60), (2, 240, 93)), picture((7, 51, 60), shape=picture((2, 240, 93)).shape)
    detector = TagDetector()
    seen = [[d.id for d in detector.track(image, {7, 2})] for image in (one, one, both, one, both)]
    assert seen == [[7], [7], [2, 7], [7], [2, 7]]


def test_tracking_measures_a_tag_that_its_region_would_cut_off() -> None:
    for step in range(20, 70, 5):  # the region ends 29 px beyond the tag
        detector = TagDetector(decimate=1.0, refine=False)
        detector.track(picture((7, 51, 60)), {7})
        image = picture((7, 51 + step, 60))
        (tag,), (expected,) = detector.track(image, {7}), detector.detect(image)
        np.testing.assert_allclose(tag.corners, expected.corners, atol=0.5)


def test_tracking_that_has_forgotten_searches_the_whole_picture() -> None:
    detector, both = TagDetector(), picture((7, 51, 60), (2, 240, 93))
    detector.track(both, {7})
    assert [d.id for d in detector.track(both, {7})] == [7]
    detector.forget()
    assert [d.id for d in detector.track(both, {7})] == [2, 7]


def test_a_region_around_a_detection_holds_its_margin() -> None:
    (tag,) = TagDetector().detect(picture((5, 60, 60)))
    assert regions_around([tag], margin=0.5) == [(11, 11, 205, 205)]


def test_the_same_picture_gives_the_same_corners_to_the_bit() -> None:
    image, _ = slanted(np.random.default_rng(5), 4.0)
    first, second = TagDetector().detect(image), TagDetector().detect(image)
    np.testing.assert_array_equal(first[0].corners, second[0].corners)


def test_an_empty_picture_has_no_tags() -> None:
    assert TagDetector().detect(np.full((100, 100), 128, np.uint8)) == ()


def test_what_cannot_be_searched_is_refused() -> None:
    detector = TagDetector()
    with pytest.raises(ValueError, match=r"expected an \(h, w\) uint8 image, got \(5, 5, 3\) uint8"):
        detector.detect(np.zeros((5, 5, 3), np.uint8))
    with pytest.raises(ValueError, match="float64"):
        detector.detect(np.zeros((50, 50)))  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="unknown tag family 'tag36h12'; expected one of tag36h11"):
        TagDetector("tag36h12")
    with pytest.raises(ValueError, match="id 587 does not exist; expected 0 to 586"):
        tag_bitmap(587)


def test_a_closed_detector_says_so() -> None:
    detector = TagDetector()
    detector.close()
    detector.close()
    with pytest.raises(NotConnected, match="it was closed"):
        detector.detect(np.zeros((50, 50), np.uint8))


def test_detectors_left_open_do_not_break_the_exit() -> None:
    code = (
        "import numpy as np; from drivers.tags import TagDetector\n"
        "kept = [TagDetector() for _ in range(5)]\n"
        "[d.detect(np.zeros((64, 64), np.uint8)) for d in kept]; del kept[0]; kept[0].close()\n"
        "kept.append(kept)\n"  # a cycle: only the collector or the exit can end it
    )
    command = [sys.executable, "-W", "error", "-c", code]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, timeout=60, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, b"", b"")


def reference(path: Path) -> list[tuple[int, np.ndarray]]:
    """Ids and corners of upstream's golden output, brought to pixel centres at integers."""
    out = []
    for line in path.read_text().splitlines():
        figures = [float(x) for x in re.findall(r"-?\d+\.?\d*", line)]
        if len(figures) == 9:
            out.append((int(figures[0]), np.array(figures[1:]).reshape(4, 2) - 0.5))
    return out


@pytest.mark.parametrize(
    ("photo", "n_tags", "n_found"), [("33369213973_9d9bb4cc96_c", 12, 12), ("34085369442_304b6bafd9_c", 25, 24)]
)
def test_tags_in_photographs_are_where_the_reference_detector_saw_them(photo: str, n_tags: int, n_found: int) -> None:
    path = recording("apriltag_umich")
    image = photograph(path / f"{photo}.jpg")
    expected = reference(path / f"{photo}.txt")
    assert len(expected) == n_tags
    found = TagDetector(decimate=1, refine=False, max_hamming=2).detect(image)
    near = [any(d.id == id and np.abs(d.corners - corners).max() < 0.2 for d in found) for id, corners in expected]
    assert sum(near) >= n_found


@pytest.fixture(scope="module")
def rotations() -> tuple[dict[int, np.ndarray], np.ndarray, float]:
    """Pictures by the angle the tag was set to, the camera's K, and the tag's size."""
    path = recording("apriltag_rotation")
    info = YAML(typ="safe").load(path / "test_info.yaml")["rotation_test"]
    pictures = {}
    for file in sorted(path.glob("test_image_rotation_*.png")):
        pictures[int(file.stem.rsplit("_", 1)[1])] = photograph(file)
    return pictures, np.array(info["K"]).reshape(3, 3), info["tag_size"]


def test_a_real_tag_turns_by_the_angle_it_was_set_to(rotations) -> None:
    pictures, K, size = rotations
    detector = TagDetector()
    R_CT = {}
    for label, image in pictures.items():
        (tag,) = detector.detect(image)
        assert tag.id == 76
        corners_T = 0.5 * size * np.array([(-1.0, -1, 0), (1, -1, 0), (1, 1, 0), (-1, 1, 0)])
        found, turn, _ = cv2.solvePnP(corners_T, tag.corners, K, np.zeros(5), flags=cv2.SOLVEPNP_ITERATIVE)
        assert found
        R_CT[label] = cv2.Rodrigues(turn)[0]
    assert len(R_CT) >= 7
    for label, R in R_CT.items():
        angle = np.degrees(np.linalg.norm(cv2.Rodrigues(R_CT[0].T @ R)[0]))
        assert angle == pytest.approx(abs(label), abs=3.5)


def test_refined_corners_of_real_tags_do_not_depend_on_the_search(rotations) -> None:
    pictures = rotations[0]
    gaps = {}
    for refine in (False, True):
        coarse, full = TagDetector(decimate=2, refine=refine), TagDetector(decimate=1, refine=refine)
        gaps[refine] = [
            np.abs(coarse.detect(p)[0].corners - full.detect(p)[0].corners).max() for p in pictures.values()
        ]
    assert max(gaps[True]) < 0.02
    assert max(gaps[False]) > 0.2
