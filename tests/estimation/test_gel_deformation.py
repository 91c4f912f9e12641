"""Shading of a gel against its reference: what presses shows, what does not is taken out, what is useless is named."""

import numpy as np
import pytest
import shapely
from numpy.typing import ArrayLike

from drivers.sim.mismatch import Mismatch, load_profile
from estimation.gel_deformation import GelReference, deformation
from estimation.gel_straight_edges import straight_edges
from estimation.tactile_pose import PoseStatus
from experiments.bench.tactile_gel import GelHand, open_gelslim

BOX = np.array([(-0.008, -0.05), (0.008, -0.05), (0.008, 0.010), (-0.008, 0.010)])
BOARD = np.array([(-0.05, -0.05), (0.05, -0.05), (0.05, 0.05), (-0.05, 0.05)])
TURNED = np.array([0.003, 0.001, np.radians(12.0)])


def pictures(
    outline=BOX,
    go: ArrayLike = TURNED,
    shear: ArrayLike = (0.0, 0.0, 0.0),
    profile: Mismatch | None = None,
    seed: int = 0,
):
    """A finger, its reference and one picture."""
    hand = GelHand(profile or load_profile("lab"), outline, np.array(go, float), shear=np.array(shear, float))
    device = open_gelslim(hand, "left")
    device.restart(np.random.default_rng(seed))
    return device, GelReference.of(device.reference()), device.capture().image


def distances(device, outline: np.ndarray, go: np.ndarray, height: float) -> np.ndarray:
    """Distance (h, w) [m] of what each pixel sees ``height`` above the gel from the outline (out > 0)."""
    camera = device.optics.camera(320, 240)
    grid = np.stack(np.meshgrid(np.arange(320), np.arange(240)), axis=-1).reshape(-1, 2)
    rays = np.column_stack((camera.undistort(grid), np.ones(len(grid)))) @ np.linalg.inv(camera.K).T
    rays = rays @ camera.X_WC[:3, :3].T
    at = camera.X_WC[:3, 3] + rays * ((height - camera.X_WC[2, 3]) / rays[:, 2])[:, None]
    c, s = np.cos(go[2]), np.sin(go[2])
    polygon = shapely.Polygon(outline @ np.array([[c, s], [-s, c]]) + go[:2])
    points = shapely.points(at[:, :2])
    far = shapely.distance(polygon.exterior, points)
    return np.where(shapely.contains(polygon, points), -far, far).reshape(240, 320)


def test_the_patch_is_the_wall_beside_the_face() -> None:
    device, reference, image = pictures()
    found = deformation(image, reference)
    d = distances(device, BOX, TURNED, 0.8e-3)
    assert found.status is PoseStatus.OK
    assert found.patch[(d > 0.2e-3) & (d < 0.6e-3)].mean() > 0.95
    assert found.patch[(d < -0.6e-3) | (d > 6e-3)].mean() < 0.002


def test_grain_is_that_of_the_camera() -> None:
    profile = Mismatch.model_validate({"gel": {"noise": 5.0}})
    _, reference, image = pictures(profile=profile)
    assert deformation(image, reference).noise == pytest.approx(5.0, rel=0.25)


def test_dots_that_are_carried_along_are_no_contact() -> None:
    """A face beyond the view carries all dots along, and tilts nothing."""
    _, reference, image = pictures(BOARD, (0, 0, 0), (6e-4, -4e-4, 0.02))
    moved = np.abs(image.astype(int) - reference.raw).max(axis=2)
    assert (moved > 30).mean() > 0.03
    assert deformation(image, reference).status is PoseStatus.NO_CONTACT


@pytest.mark.parametrize(("gain", "ramp"), [(0.88, 0.0), (1.1, 0.0), (1.0, 14.0), (0.93, -10.0)])
def test_exposure_and_drifting_light_are_no_contact(gain: float, ramp: float) -> None:
    hand = GelHand(load_profile("lab"), BOX, TURNED, held=False)
    device = open_gelslim(hand, "left")
    reference = GelReference.of(device.reference())
    slope = np.linspace(-ramp, ramp, 320)[None, :, None]
    lit = np.clip(device.capture().image * gain + slope, 0, 250).round().astype(np.uint8)
    assert deformation(lit, reference).status is PoseStatus.NO_CONTACT


def test_exposure_does_not_move_the_patch() -> None:
    _, reference, image = pictures()
    brighter = np.clip(image * 1.08 + 2, 0, 255).round().astype(np.uint8)
    one, other = (deformation(i, reference).patch for i in (image, brighter))
    assert (one != other).mean() < 0.01


def useless_pictures() -> dict[str, tuple[PoseStatus, object]]:
    def rows_gone(image: np.ndarray) -> np.ndarray:
        out = image.copy()
        out[150:] = 0
        return out

    def rows_repeated(image: np.ndarray) -> np.ndarray:
        out = image.copy()
        out[100:120] = out[100]
        return out

    return {
        "covered": (PoseStatus.BLANK, lambda image: np.full_like(image, 7)),
        "grey": (PoseStatus.BLANK, lambda image: (image * 0 + 128).astype(np.uint8)),
        "rows gone": (PoseStatus.TORN, rows_gone),
        "rows repeated": (PoseStatus.TORN, rows_repeated),
        "another scene": (PoseStatus.TORN, lambda image: np.ascontiguousarray(image[::-1, :, ::-1])),
        "overexposed": (PoseStatus.SATURATED, lambda image: np.minimum(image * 2.2, 255).astype(np.uint8)),
        "another size": (PoseStatus.UNTRUSTED, lambda image: image[:120]),
        "depth": (PoseStatus.UNTRUSTED, lambda image: image[..., 0].astype(np.uint16)),
    }


@pytest.mark.parametrize("name", list(useless_pictures()))
def test_a_picture_of_no_use_says_why(name: str) -> None:
    _, reference, image = pictures()
    status, spoil = useless_pictures()[name]
    found = deformation(spoil(image), reference)  # type: ignore[operator]
    assert found.status is status
    assert found.reason
    assert not found.patch.any()


def test_a_reference_of_one_colour_is_refused() -> None:
    with pytest.raises(ValueError, match="lights"):
        GelReference.of(np.full((240, 320, 3), 90, np.uint8))
    with pytest.raises(ValueError, match="BGR"):
        GelReference.of(np.zeros((240, 320), np.uint16))


@pytest.mark.parametrize("seed", range(3))
def test_straight_edges_are_the_sides_of_the_face(seed: int) -> None:
    """The three sides in view, by lines that are projected by the camera itself."""
    device, reference, image = pictures(seed=seed)
    camera = device.optics.camera(320, 240)
    c, s = np.cos(TURNED[2]), np.sin(TURNED[2])
    corners = BOX @ np.array([[c, s], [-s, c]]) + TURNED[:2]
    found = straight_edges(image, reference)
    assert len(found) >= 3
    for start, end in ((1, 2), (2, 3), (3, 0)):
        middle = np.array([0.25, 0.75])[:, None]
        a, b = corners[start], corners[end]
        if np.abs(a[1]) > 0.04:
            a = b + (a - b) * 0.25  # the part in view
        if np.abs(b[1]) > 0.04:
            b = a + (b - a) * 0.25
        p = a + middle * (b - a)
        seen = camera.project(np.column_stack((p, np.full(2, 0.8e-3))))
        along = (seen[1] - seen[0]) / np.linalg.norm(seen[1] - seen[0])
        across = np.array([-along[1], along[0]])
        angles = [
            np.degrees(np.arcsin(np.clip(np.cos(e.angle) * across[0] + np.sin(e.angle) * across[1], -1, 1)))
            for e in found
        ]
        offsets = [np.abs((e.centre - seen[0]) @ across) for e in found]
        assert any(abs(angle) < 1.5 and offset < 1.5 for angle, offset in zip(angles, offsets, strict=True))


def test_an_untouched_gel_has_no_straight_edges() -> None:
    hand = GelHand(load_profile("lab"), BOX, TURNED, held=False)
    device = open_gelslim(hand, "left")
    assert straight_edges(device.capture().image, device.reference()) == []
