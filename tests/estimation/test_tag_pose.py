import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers.scene import TagMount
from drivers.sim.tag_camera import TagRenderer
from drivers.tags import TagDetector
from estimation.tag_pose import PIXEL_SIGMA, _reprojection, _Sighting, estimate_planar_pose
from mechanics.camera import CameraModel, TagGeometry
from mechanics.readings import TagDetection

STRAIGHT = (0.0, 0.0, 0.0, 0.0, 0.0)
CURVED = (-0.25, 0.08, 0.001, -0.002, 0.0)
CAMERA = CameraModel.looking_at((0.02, -0.45, 0.08), (0.0, 0.0, 0.03), 1400, 1280, 720)
GO = TagGeometry(id=10, size=0.036, pose=(0.0, -0.04, 0.0), height=0.003)
TABLE = [TagGeometry(id=i, size=0.04, pose=(x, -0.04, 0.0)) for i, x in enumerate((-0.15, -0.05, 0.05, 0.15))]
UPRIGHT = np.array([0.02, 0.09, 0.3])


def seen(camera: CameraModel, geometry: TagGeometry, X_W_body: np.ndarray) -> TagDetection:
    """The detection of a perfect camera, by complex numbers and OpenCV."""
    z = 0.5 * geometry.size * np.array([-1 - 1j, 1 - 1j, 1 + 1j, -1 + 1j])
    for x, y, theta in (geometry.pose, X_W_body):
        z = np.exp(1j * theta) * z + complex(x, y)
    p_W = np.column_stack((z.real, np.full(4, -geometry.height), z.imag))
    R_CW = camera.X_WC[:3, :3].T
    t = -R_CW @ camera.X_WC[:3, 3]
    pixels, _ = cv2.projectPoints(p_W[:, None], cv2.Rodrigues(R_CW)[0], t, camera.K, camera.distortion)
    return TagDetection(geometry.id, np.asarray(pixels, np.float64).reshape(4, 2), 0, 100.0)


def moved(detection: TagDetection, by) -> TagDetection:
    return TagDetection(detection.id, detection.corners + by, 0, 100.0)


@given(
    st.floats(-0.1, 0.1),
    st.floats(0.0, 0.1),
    st.floats(-np.pi, np.pi, exclude_min=True),
    st.floats(-0.02, 0.02),
    st.sampled_from([STRAIGHT, CURVED]),
)
@settings(max_examples=50)
def test_perfect_corners_give_the_pose(x: float, y: float, theta: float, height: float, distortion) -> None:
    camera = CameraModel.looking_at((0.05, -0.5, 0.2), (0.0, 0.0, 0.03), 1200, 1280, 720, distortion)
    tags = [TagGeometry(1, 0.03, (0.02, -0.01, 0.7), height), TagGeometry(2, 0.02, (-0.02, 0.01, -2.0), 2 * height)]
    X_W_body = np.array([x, y, theta])
    for geometries in (tags[:1], tags):
        estimate = estimate_planar_pose(camera, [seen(camera, g, X_W_body) for g in geometries], tags)
        assert estimate is not None
        gap = estimate.pose - X_W_body
        gap[2] = np.angle(np.exp(1j * gap[2]))
        np.testing.assert_allclose(gap, 0, atol=1e-9)
        assert -np.pi - 1e-9 <= estimate.pose[2] <= np.pi + 1e-9
        assert estimate.residual_px < 1e-6
        assert (estimate.n_tags, estimate.rejected) == (len(geometries), ())


@pytest.mark.parametrize("distortion", [STRAIGHT, CURVED])
def test_jacobian_of_the_reprojection_is_that_of_finite_differences(distortion) -> None:
    camera = CameraModel.looking_at((0.05, -0.5, 0.2), (0.0, 0.0, 0.03), 1200, 1280, 720, distortion)
    sightings = [_Sighting(g.id, seen(camera, g, UPRIGHT).corners, g.corners, g.height) for g in (GO, TABLE[2])]
    pose = UPRIGHT + np.array([0.01, -0.02, 0.1])
    step = 1e-6
    columns = [
        (_reprojection(camera, sightings, pose + d)[0] - _reprojection(camera, sightings, pose - d)[0]) / (2 * step)
        for d in step * np.eye(3)
    ]
    np.testing.assert_allclose(
        _reprojection(camera, sightings, pose)[1], np.column_stack(columns), rtol=1e-6, atol=1e-4
    )


@pytest.mark.parametrize("geometries", [[GO], TABLE], ids=["one tag", "four tags"])
def test_stated_covariance_is_the_scatter_of_estimates_from_noisy_corners(geometries: list[TagGeometry]) -> None:
    rng = np.random.default_rng(4)
    X_W_body = UPRIGHT if geometries == [GO] else np.array([0.001, 0.002, 0.01])
    perfect = [seen(CAMERA, g, X_W_body) for g in geometries]
    sigma, errors, covariance = 0.1, [], np.zeros((3, 3))
    for _ in range(400):
        noisy = [moved(d, rng.normal(0, sigma, (4, 2))) for d in perfect]
        estimate = estimate_planar_pose(CAMERA, noisy, geometries, sigma=sigma)
        assert estimate is not None and estimate.n_tags == len(geometries)
        errors.append(estimate.pose - X_W_body)
        covariance = estimate.covariance
    squared = np.einsum("ni,ij,nj->n", errors, np.linalg.inv(covariance), errors)
    assert squared.mean() == pytest.approx(3.0, abs=0.5)  # χ² with 3 degrees of freedom; ± 4 standard errors
    assert np.mean(squared > 11.34) < 0.03  # 1 % by rights


def test_default_covariance_covers_pictures_with_four_grey_levels_of_noise() -> None:
    rng = np.random.default_rng(6)
    camera = CameraModel.looking_at((0.0, -0.45, 0.05), (0.0, 0.0, 0.05), 1400, 440, 440)
    mount = TagMount(**{name: getattr(GO, name) for name in ("id", "size", "pose", "height")})
    renderer, detector = TagRenderer(camera), TagDetector()
    squared = []
    for _ in range(40):
        X_W_body = rng.uniform((-0.02, 0.08, 0.0), (0.02, 0.1, 0.6))
        picture = renderer.render([(mount, X_W_body)]) + rng.normal(0, 4, (440, 440))
        detections = detector.detect(np.clip(np.rint(picture), 0, 255).astype(np.uint8))
        estimate = estimate_planar_pose(camera, detections, [GO])
        assert estimate is not None
        error = estimate.pose - X_W_body
        squared.append(error @ np.linalg.inv(estimate.covariance) @ error)
    assert 1.0 < np.mean(squared) < 5.0  # 3 by rights
    assert PIXEL_SIGMA == 0.01


def test_more_tags_and_wider_ones_are_surer() -> None:
    one = estimate_planar_pose(CAMERA, [seen(CAMERA, TABLE[1], np.zeros(3))], TABLE)
    four = estimate_planar_pose(CAMERA, [seen(CAMERA, g, np.zeros(3)) for g in TABLE], TABLE)
    assert one is not None and four is not None
    assert np.sqrt(four.covariance[2, 2]) < 0.2 * np.sqrt(one.covariance[2, 2])


def test_a_tag_that_disagrees_with_the_others_is_left_out() -> None:
    perfect = [seen(CAMERA, g, np.zeros(3)) for g in TABLE]
    for shifted in range(4):
        spoiled = [moved(d, (6.0, -4.0)) if d.id == shifted else d for d in perfect]
        estimate = estimate_planar_pose(CAMERA, spoiled, TABLE)
        assert estimate is not None
        np.testing.assert_allclose(estimate.pose, 0, atol=1e-9)
        assert (estimate.n_tags, estimate.rejected) == (3, (shifted,))


def test_of_two_sightings_of_one_tag_the_one_that_fits_counts() -> None:
    perfect = [seen(CAMERA, g, np.zeros(3)) for g in TABLE[:2]]
    estimate = estimate_planar_pose(CAMERA, [moved(perfect[0], 20.0), *perfect], TABLE)
    assert estimate is not None
    np.testing.assert_allclose(estimate.pose, 0, atol=1e-9)
    assert (estimate.n_tags, estimate.rejected) == (2, (0,))


def test_a_square_that_no_pose_explains_gives_no_pose() -> None:
    detection = seen(CAMERA, GO, UPRIGHT)
    for spoil in ([(8, 0), (0, 0), (-8, 0), (0, 0)], np.nan, 1e6, -detection.corners):
        assert estimate_planar_pose(CAMERA, [moved(detection, spoil)], [GO]) is None


@pytest.mark.parametrize("geometries", [[], TABLE])
def test_without_a_known_tag_there_is_no_pose(geometries: list[TagGeometry]) -> None:
    assert estimate_planar_pose(CAMERA, [seen(CAMERA, GO, UPRIGHT)], geometries) is None
    assert estimate_planar_pose(CAMERA, [], geometries) is None
