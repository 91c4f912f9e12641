"""A tag board before the simulated camera: its geometry, its picture, and the way it gets there."""

from __future__ import annotations

import json
import socket
from collections.abc import Callable

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from drivers.config import StationConfig, TagCameraConfig
from drivers.errors import CommandRefused
from drivers.scene import Scene, TagMount
from drivers.sim.camera_errors import actual
from drivers.sim.mismatch import CameraFigures, Mismatch
from drivers.sim.tag_camera import SimTagCamera, TagRenderer
from drivers.sim.world import World
from drivers.station import Station
from drivers.tags import TagDetector, tag_bitmap
from mechanics.camera import CameraModel
from mechanics.tag_board import TagBoard

STRAIGHT = np.zeros(5)
CURVED = np.array([-0.25, 0.08, 0.001, -0.002, 0.0])
#: the printed side toward the viewer, upright: its x is the world's X, its y the world's Z
UPRIGHT = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
SMALL = TagBoard(columns=3, rows=2, size=0.03, gap=0.01, first_id=200)
CAMERA = {"kind": "tag_camera", "position": (0.0, -0.5, 0.05), "look_at": (0.0, 0.0, 0.05), "focal": 800}


def camera_of(distortion: np.ndarray = STRAIGHT, width: int = 640, height: int = 480) -> CameraModel:
    return CameraModel.looking_at((0.0, -0.5, 0.05), (0.0, 0.0, 0.05), 1000, width, height, distortion)


def shown(
    tilt: tuple[float, float, float] = (0, 0, 0), at: tuple[float, float, float] = (0, -0.05, 0.05)
) -> np.ndarray:
    X_W_B = np.eye(4)
    X_W_B[:3, :3] = UPRIGHT @ Rotation.from_euler("xyz", tilt, degrees=True).as_matrix()
    X_W_B[:3, 3] = at
    return X_W_B


def opencv(camera: CameraModel, p_W: np.ndarray) -> np.ndarray:
    R_CW = camera.X_WC[:3, :3].T
    t = -R_CW @ camera.X_WC[:3, 3]
    pixels, _ = cv2.projectPoints(p_W.reshape(-1, 1, 3), cv2.Rodrigues(R_CW)[0], t, camera.K, camera.distortion)
    return np.asarray(pixels, float).reshape(-1, 2)


# -- geometry ----------------------------------------------------------------------------------------------------------


def test_tags_stand_in_rows_from_the_lower_left() -> None:
    assert SMALL.ids == (200, 201, 202, 203, 204, 205)
    assert [SMALL.centre(id) for id in (200, 202, 203)] == [
        pytest.approx((-0.04, -0.02)),
        pytest.approx((0.04, -0.02)),
        pytest.approx((-0.04, 0.02)),
    ]
    corners = SMALL.points()[201]
    np.testing.assert_allclose(corners[0], (-0.015, -0.035, 0))
    np.testing.assert_allclose(corners[2], (0.015, -0.005, 0))
    assert SMALL.half_size == pytest.approx((0.065, 0.045))


def test_a_board_survives_json() -> None:
    assert TagBoard.from_dict(json.loads(json.dumps(SMALL.as_dict()))) == SMALL
    assert TagBoard.from_dict({}) == TagBoard()


@pytest.mark.parametrize(
    ("values", "word"),
    [
        ({"columns": 0}, "columns"),
        ({"rows": 2.5}, "rows"),
        ({"size": float("nan")}, "size"),
        ({"size": -0.03}, "size"),
        ({"gap": 0.005}, "two white cells"),
        ({"first_id": 580}, "beyond id 586"),
        ({"first_id": -1}, "first_id"),
        ({"colour": "red"}, "unknown colour"),
        ({"size": "wide"}, "tag board"),
    ],
)
def test_a_board_that_cannot_be_printed_is_refused(values: dict, word: str) -> None:
    with pytest.raises(ValueError, match=word):
        TagBoard.from_dict(values)


# -- the picture -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("distortion", "bound"), [(STRAIGHT, 0.006), (CURVED, 0.012)])
@pytest.mark.parametrize("tilt", [(0, 0, 0), (35, 0, 0), (0, -40, 20), (-25, 30, 130)], ids=str)
def test_detected_corners_are_the_projected_ones_at_any_tilt(tilt, distortion: np.ndarray, bound: float) -> None:
    camera, X_W_B = camera_of(distortion), shown(tilt)
    found = TagDetector(camera=camera).detect(TagRenderer(camera).render([], [], (SMALL, X_W_B)))
    assert [tag.id for tag in found] == list(SMALL.ids)
    p_W = np.array([SMALL.points()[tag.id] for tag in found]) @ X_W_B[:3, :3].T + X_W_B[:3, 3]
    errors = np.array([tag.corners for tag in found]).reshape(-1, 2) - opencv(camera, p_W)
    assert np.sqrt(np.mean(np.square(errors))) < bound


def test_each_pixel_is_the_mean_over_its_square() -> None:
    camera, board, X_W_B = camera_of(width=160, height=140), TagBoard(1, 1, 0.03, 0.01, 42), shown((25, -30, 10))
    n = 8  # rays to a side of a pixel
    axes = [(np.arange(size * n) + 0.5) / n - 0.5 for size in (160, 140)]
    grid = np.stack(np.meshgrid(*axes), axis=-1)
    rays = np.concatenate((grid, np.ones((*grid.shape[:2], 1))), axis=-1) @ np.linalg.inv(camera.K).T
    rays = rays @ camera.X_WC[:3, :3].T
    normal, origin, eye = X_W_B[:3, 2], X_W_B[:3, 3], camera.X_WC[:3, 3]
    p_W = eye + rays * ((origin - eye) @ normal / (rays @ normal))[..., None]
    x, y = np.moveaxis((p_W - origin) @ X_W_B[:3, :2], -1, 0)
    paper = (np.abs(x) < 0.025) & (np.abs(y) < 0.025)
    column, row = (np.floor(v / 0.03 * 8 + 5).astype(int) for v in (x, -y))
    tag = (column >= 0) & (column < 10) & (row >= 0) & (row < 10)
    dark = tag & (tag_bitmap(42)[np.clip(row, 0, 9), np.clip(column, 0, 9)] == 0)
    grey = np.where(dark, 20.0, np.where(paper, 235.0, 128.0))
    expected = grey.reshape(140, n, 160, n).mean(axis=(1, 3))
    assert expected.min() < 30 and expected.max() > 225
    difference = TagRenderer(camera).paint([], [], (board, X_W_B)) - expected
    assert np.sqrt(np.mean(difference**2)) < 1.0
    assert abs(difference.mean()) < 0.05


def test_the_back_of_a_board_is_blank_paper() -> None:
    turned = shown((0, 180, 0))
    picture = TagRenderer(camera_of()).render([], [], (SMALL, turned))
    assert set(np.unique(picture[200:280, 260:380])) == {235}
    assert TagDetector().detect(picture) == ()


def test_a_board_hides_what_is_behind_it() -> None:
    renderer, detector = TagRenderer(camera_of()), TagDetector()
    covered, beside = TagMount(id=1, size=0.02, pose=(0.0, 0.05, 0)), TagMount(id=2, size=0.02, pose=(0.12, 0.05, 0))
    tags = [(covered, np.zeros(3)), (beside, np.zeros(3))]
    assert [tag.id for tag in detector.detect(renderer.render(tags))] == [1, 2]
    assert [tag.id for tag in detector.detect(renderer.render(tags, [], (SMALL, shown())))] == [2, *SMALL.ids]


def test_a_board_behind_the_camera_or_across_its_plane_is_not_drawn() -> None:
    renderer = TagRenderer(camera_of())
    for at in ((0, -0.9, 0.05), (0, -0.5, 0.05)):
        assert (renderer.render([], [], (SMALL, shown((90, 0, 0), at))) == 128).all()  # type: ignore[arg-type]


# -- the way there -----------------------------------------------------------------------------------------------------


@pytest.fixture
def config(station: StationConfig) -> StationConfig:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    camera = TagCameraConfig.model_validate(CAMERA | {"width": 480, "height": 360})
    bus = station.bus.model_copy(update={"endpoint": f"tcp/127.0.0.1:{port}"})
    return station.model_copy(update={"devices": {"arm": station.devices["arm"], "camera": camera}, "bus": bus})


def seen_by(camera) -> list[int]:
    return [tag.id for tag in camera.capture().detections]


def test_the_world_holds_a_board_up_until_it_is_put_away_or_reset(
    config: StationConfig, make_scene: Callable[..., Scene]
) -> None:
    world = World(config)
    world.reset(0, make_scene())
    camera = world.devices["camera"]
    with camera:
        world.show_board(SMALL.as_dict(), shown())
        assert seen_by(camera) == list(SMALL.ids)
        assert seen_by(camera) == list(SMALL.ids)
        world.show_board(None, np.eye(4))
        assert seen_by(camera) == []
        world.show_board(SMALL, shown())
        world.reset(0, make_scene())
        assert seen_by(camera) == []


@pytest.mark.parametrize(
    ("board", "pose", "word"),
    [
        ({"columns": 0}, np.eye(4), "columns"),
        ([1, 2], np.eye(4), "mapping"),
        ({}, np.eye(3), "4 x 4"),
        ({}, 2 * np.eye(4), "rotation"),
        ({}, np.full((4, 4), np.nan), "finite"),
        ({}, "there", "could not convert"),
    ],
    ids=["board", "list", "planar", "scaled", "nan", "text"],
)
def test_what_cannot_be_shown_is_refused(config: StationConfig, board, pose, word: str) -> None:
    with pytest.raises(CommandRefused, match=word):
        World(config).show_board(board, pose)


def test_a_station_without_a_camera_refuses_a_board(station: StationConfig) -> None:
    with pytest.raises(CommandRefused, match="no tag camera"):
        World(station).show_board({}, np.eye(4))


def test_a_board_is_shown_over_the_bus(config: StationConfig, make_scene: Callable[..., Scene]) -> None:
    with Station(config).connect() as devices:
        simulation = devices.simulation
        assert simulation is not None
        simulation.reset(0, make_scene().model_dump(mode="json"))
        simulation.show_board(SMALL.as_dict(), shown())
        assert seen_by(devices.camera) == list(SMALL.ids)
        with pytest.raises(CommandRefused, match="two white cells"):
            simulation.show_board(SMALL.as_dict() | {"gap": 0.001}, shown())
        simulation.show_board(None, np.eye(4))
        assert seen_by(devices.camera) == []


class _Booth:
    lockstep = True

    def __init__(self, figures: CameraFigures):
        self.profile = Mismatch(camera=figures)

    def now_ns(self) -> int:
        return 0

    def visible_tags(self):
        return []

    def tag_twists(self):
        return {}

    def screens(self):
        return []


def test_what_calibration_left_of_lens_and_focal_length_shows_on_the_board() -> None:
    figures = CameraFigures(distortion=(-0.1, 0.05, 0, 0, 0), distortion_error=0.1, focal_error=0.01)
    camera = SimTagCamera("camera", TagCameraConfig.model_validate(CAMERA), _Booth(figures))
    with camera:
        camera.restart(np.random.default_rng(4))
        camera.show(SMALL, shown((20, 10, 0)))
        found = camera.capture().detections
    described = CameraModel.from_dict(camera.describe().extra["camera"])
    true = actual(described, figures, np.random.default_rng(4))
    assert true.K[0, 0] != described.K[0, 0]
    X_W_B = shown((20, 10, 0))
    p_W = np.array([SMALL.points()[tag.id] for tag in found]) @ X_W_B[:3, :3].T + X_W_B[:3, 3]
    off = {
        name: np.abs(np.array([tag.corners for tag in found]).reshape(-1, 2) - opencv(model, p_W)).max()
        for name, model in (("true", true), ("described", described))
    }
    assert off["true"] < 0.05
    assert off["described"] > 0.3
