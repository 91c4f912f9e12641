"""Contact records of every shape: corner on face, face on corner, face on face, and no seams within a face."""

from __future__ import annotations

import numpy as np
import pytest

from drivers.scene import Body
from drivers.sim.plant import Plant
from mechanics.catalogue import load_object
from mechanics.polygon import Polygon

SHAPES = ("hbox", "heptagon", "pentagon", "tall_box", "triangle", "z")
REST = (0.0, 0.0, 0.0)
HALF = np.array([0.025, 0.07345])
STIFFNESS = ((2200.0, 0.0, 0.0), (0.0, 1900.0, 0.0), (0.0, 0.0, 5.0))
#: nothing slides unless a test wants it to
GRIPPY = {"go-ground": 2.0, "go-eo": 2.0, "eo-ground": 2.0}


def turn(angle: float) -> np.ndarray:
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def outline(shape: str) -> np.ndarray:
    """Vertices as the shape stands at x = 0 on the table."""
    vertices = np.asarray(load_object(shape).polygon.vertices)
    return vertices - [0.0, vertices[:, 1].min()]


def standing(make_scene, vertices: np.ndarray, mass: float, go: np.ndarray, **parts) -> Plant:
    """The eo, flat on the table, and the go clear of it at about ``go``."""
    polygon = Polygon(vertices)
    local = tuple(map(tuple, (polygon.vertices - polygon.centroid).tolist()))
    grasp = go[:2] + turn(go[2]) @ [0.0, 0.045]
    x, y = polygon.centroid.tolist()
    scene = make_scene(
        extrinsic=Body(name="eo", vertices=local, mass=mass),
        extrinsic_pose=(x, y, 0.0),
        start=(*grasp.tolist(), float(go[2])),
        stiffness=STIFFNESS,
        **({"friction": GRIPPY} | parts),
    )
    return Plant(scene)


def press(plant: Plant, way, seconds: float = 0.6) -> None:
    start, way = plant.ee, np.append(way, 0.0)
    n = round(seconds / plant.timestep)
    for i in range(1, n + 1):
        plant.step(tuple((start + way * i / n).tolist()), tuple((way / seconds).tolist()))
    for _ in range(300):
        plant.step(plant.ee_pose, REST)


def by_go(plant: Plant) -> list:
    return [contact for contact in plant.contacts() if contact.by == "go"]


def balance(plant: Plant) -> np.ndarray:
    """What fingers, weight and contacts leave of the forces on the go: nothing at rest."""
    force = plant.coupling_wrench()[:2] + np.array([0.0, -0.1 * 9.81])
    return force + sum((c.force if c.on == "go" else -c.force for c in plant.contacts() if "go" in (c.on, c.by)), 0.0)


def upper_face(vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Ends (2, 2) of the face that looks up the most, and its outward normal."""
    ends = np.stack([vertices, np.roll(vertices, -1, axis=0)], axis=1)
    edges = ends[:, 1] - ends[:, 0]
    normals = np.stack([edges[:, 1], -edges[:, 0]], axis=1) / np.linalg.norm(edges, axis=1)[:, None]
    top = np.argmax(normals[:, 1] + 1e-6 * ends.mean(axis=1)[:, 1])
    return ends[top], normals[top]


@pytest.mark.parametrize("shape", SHAPES)
def test_corner_of_the_go_on_a_face(make_scene, shape):
    vertices = outline(shape)
    ends, normal = upper_face(vertices)
    touch = ends.mean(axis=0)
    # the go's lower left corner points against the normal
    angle = np.arctan2(-normal[1], -normal[0]) - np.arctan2(-HALF[1], -HALF[0])
    go = np.append(touch + 3e-3 * normal - turn(angle) @ -HALF, angle)
    plant = standing(make_scene, vertices, 5.0, go)
    press(plant, -7e-3 * normal)
    (contact,) = by_go(plant)
    assert (contact.on, contact.mode) == ("eo", "stick")
    corner = plant.go[:2] + turn(plant.go[2]) @ -HALF
    np.testing.assert_allclose(contact.point, corner, atol=5e-6)
    np.testing.assert_allclose(contact.normal, -normal, atol=1e-4)
    assert -contact.force @ normal > 2.0, "it presses on the eo"
    # on the face's line, no deeper than a few micrometres
    assert abs((contact.point - touch) @ normal) < 20e-6
    np.testing.assert_allclose(balance(plant), 0.0, atol=2e-3)
    assert plant.health()["flags"] == []


@pytest.mark.parametrize("shape", SHAPES)
def test_face_of_the_go_on_a_corner(make_scene, shape):
    vertices = outline(shape)
    # the highest corner, the right one of a flat top; the go leans so that its lower face touches nothing else
    highest = vertices[vertices[:, 1] > vertices[:, 1].max() - 1e-9]
    apex = highest[np.argmax(highest[:, 0])]
    angle = np.radians(12.0) if len(highest) > 1 else 0.0
    angle = -angle
    down = turn(angle) @ [0.0, -1.0]
    along = turn(angle) @ [1.0, 0.0]
    go = np.append(apex - down * (HALF[1] + 3e-3) - 3e-3 * along, angle)
    plant = standing(make_scene, vertices, 5.0, go)
    press(plant, 6e-3 * down)
    (contact,) = by_go(plant)
    assert (contact.on, contact.mode) == ("eo", "stick")
    # the normal is that of the go's face, into the eo
    np.testing.assert_allclose(contact.normal, turn(plant.go[2]) @ [0.0, -1.0], atol=1e-4)
    np.testing.assert_allclose(contact.point, apex, atol=30e-6)
    assert contact.force @ contact.normal > 2.0
    np.testing.assert_allclose(balance(plant), 0.0, atol=2e-3)
    assert plant.health()["flags"] == []


@pytest.mark.parametrize("shape", ["hbox", "tall_box", "z"])
def test_face_of_the_go_flat_on_a_face(make_scene, shape):
    vertices = outline(shape)
    ends, _ = upper_face(vertices)
    left, right = np.sort(ends[:, 0])
    middle = 0.5 * (left + right)
    go = np.array([middle, ends[0, 1] + HALF[1] + 3e-3, 0.0])
    plant = standing(make_scene, vertices, 5.0, go)
    press(plant, (0.0, -6e-3))
    contacts = by_go(plant)
    for contact in contacts:
        assert (contact.on, contact.mode) == ("eo", "stick")
        np.testing.assert_allclose(contact.normal, [0.0, -1.0], atol=1e-4)
    # the faces overlap between these, and that is where they press
    xs = [contact.point[0] for contact in contacts]
    assert (min(xs), max(xs)) == pytest.approx((max(left, middle - 0.025), min(right, middle + 0.025)), abs=1e-4)
    np.testing.assert_allclose(balance(plant), 0.0, atol=2e-3)
    # both moments about the grasp centre: of the contacts, and of the fingers
    grasp = plant.go[:2] + turn(plant.go[2]) @ [0.0, 0.045]
    arms = [(c.point - grasp)[0] * -c.force[1] - (c.point - grasp)[1] * -c.force[0] for c in contacts]
    weight = -(plant.go[0] - grasp[0]) * 0.981
    assert plant.coupling_wrench()[2] + sum(arms) + weight == pytest.approx(0.0, abs=1e-4)
    assert plant.health()["flags"] == []


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_stands_on_its_lower_face(make_scene, shape):
    vertices = outline(shape)
    plant = standing(make_scene, vertices, 0.3, np.array([0.5, 0.3, 0.0]))
    for _ in range(300):
        plant.step(plant.ee_pose, REST)
    contacts = plant.contacts()
    low = vertices[vertices[:, 1] < 1e-9]
    assert [(c.on, c.by, c.mode) for c in contacts] == [("eo", "ground", "stick")] * len(contacts)
    xs = [contact.point[0] for contact in contacts]
    assert (min(xs), max(xs)) == pytest.approx((low[:, 0].min(), low[:, 0].max()), abs=1e-5)
    np.testing.assert_allclose(sum(c.force for c in contacts), [0.0, 0.3 * 9.81], atol=1e-3)
    assert plant.deepest() < 3e-6


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_can_be_held_and_pressed_on_the_ground(make_scene, shape):
    model = load_object(shape)
    body = Body.model_validate(model.body("go"))
    vertices = np.asarray(model.polygon.vertices)
    angle = 0.2
    corner = min(vertices @ turn(angle).T, key=lambda p: p[1])
    plant = Plant(
        make_scene(
            grasped=body,
            grasp=(0.0, 0.0, 0.0),
            stiffness=STIFFNESS,
            friction=GRIPPY,
            start=(0, 3e-3 - corner[1], angle),
        )
    )
    press(plant, (0.0, -8e-3))
    (contact,) = plant.contacts()
    assert (contact.on, contact.by, contact.mode) == ("go", "ground", "stick")
    np.testing.assert_allclose(contact.normal, [0.0, 1.0], atol=1e-9)
    lowest = min(vertices @ turn(plant.go[2]).T, key=lambda p: p[1]) + plant.go[:2]
    np.testing.assert_allclose(contact.point, lowest, atol=5e-6)
    assert contact.force[1] > 2.0


@pytest.mark.parametrize("off", [-0.5e-3, -0.02e-3, 0.0, 0.02e-3, 0.5e-3])
def test_corner_on_the_seam_of_two_pieces_stands_as_on_one_face(make_scene, off):
    """A user's polygon: a bridge whose halves meet below a straight corner in the middle of its upper face."""
    bridge = np.array([(-60, 0), (-10, 0), (0, 20), (10, 0), (60, 0), (60, 30), (0, 30), (-60, 30)]) * 1e-3
    pieces = Polygon(bridge).convex_pieces()
    assert sum(np.isclose(piece, [0.0, 0.03]).all(axis=1).any() for piece in pieces) == 2
    filled = np.array([(-60, 0), (60, 0), (60, 30), (-60, 30)]) * 1e-3
    records = []
    for vertices in (bridge, filled):
        go = np.append(np.array([off, 0.033]) - turn(0.3) @ -HALF, 0.3)
        plant = standing(make_scene, vertices, 8.0, go)
        press(plant, (0.0, -6e-3))
        (contact,) = by_go(plant)
        records.append(contact)
    seamed, plain = records
    np.testing.assert_allclose(seamed.normal, [0.0, -1.0], atol=1e-5)
    np.testing.assert_allclose(seamed.point, plain.point, atol=1e-6)
    np.testing.assert_allclose(seamed.force, plain.force, atol=5e-3)


@pytest.mark.parametrize("direction", [-1, 1])
def test_records_say_what_the_engine_says_of_each_contact(make_scene, direction):
    """Forces, read from the solver's rows, are those of the engine's own accessor."""
    import mujoco

    plant = standing(make_scene, outline("hbox"), 0.5, np.array([0.02, 0.06 + HALF[1] + 3e-3, 0.0]))
    press(plant, (direction * 1e-3, -5e-3))
    total = np.zeros(6)
    by_engine: dict[tuple[str, str], np.ndarray] = {}
    for i, contact in enumerate(plant.data.contact):
        mujoco.mj_contactForce(plant.model, plant.data, i, total)  # pyright: ignore[reportAttributeAccessIssue]
        pair = tuple(plant.model.geom(g).name.rstrip("0123456789") for g in contact.geom)
        force = total[:3] @ contact.frame.reshape(3, 3)
        by_engine[pair] = by_engine.get(pair, np.zeros(2)) + force[[0, 2]]
    for pair, force in by_engine.items():
        recorded = sum((c.force for c in plant.contacts() if (c.by, c.on) == pair), np.zeros(2))
        np.testing.assert_allclose(recorded, force, atol=1e-12)
    assert set(by_engine) == {("ground", "eo"), ("go", "eo")}


@pytest.mark.parametrize("speed", [-0.02, -0.002, 0.002, 0.02])
def test_slipping_corner_stays_closed_and_at_its_cone(make_scene, speed):
    """From rest to a steady slip at once, and to rest again: no step without contact, friction at µ while it slips."""
    plant = standing(
        make_scene,
        outline("hbox"),
        8.0,
        np.append(np.array([0.0, 0.063]) - turn(0.3) @ -HALF, 0.3),
        friction={"go-ground": 0.33, "go-eo": 0.33, "eo-ground": 2.0},
    )
    press(plant, (0.0, -6e-3))
    assert len(by_go(plant)) == 1
    changes, slipping = plant.contact_changes, []
    x, y, angle = plant.ee_pose
    steps = round(0.01 / abs(speed) * 1e3)
    for i in range(1, steps + 1):
        plant.step((x + speed * i * 1e-3, y, angle), (speed, 0.0, 0.0))
        slipping += [contact for contact in by_go(plant) if contact.mode != "stick"]
    # the fingers give way first, for most of the way
    assert len(slipping) > 0.2 * steps
    ratios = [abs(contact.force[0] / contact.force[1]) for contact in slipping]
    np.testing.assert_allclose(ratios, 0.33, rtol=2e-3)
    for _ in range(300):
        plant.step(plant.ee_pose, REST)
    assert plant.contact_changes == changes
    (contact,) = by_go(plant)
    assert contact.mode == "stick"
    assert plant.health()["flags"] == []
