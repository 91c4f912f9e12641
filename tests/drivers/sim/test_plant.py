"""The plant against closed forms: weight, friction, tipping, sag, and what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.errors import DeviceFault
from drivers.scene import Body, Scene
from drivers.sim.coupling import Coupling
from drivers.sim.plant import Plant

WEIGHT = 0.5 * 9.81  # of hbox
REST = (0.0, 0.0, 0.0)


def rectangle(width: float, height: float) -> tuple[tuple[float, float], ...]:
    w, h = width / 2, height / 2
    return ((-w, -h), (w, -h), (w, h), (-w, h))


def rest(plant: Plant, seconds: float) -> None:
    for _ in range(round(seconds / plant.timestep)):
        plant.step(plant.ee_pose, REST)


@pytest.fixture
def hbox(make_scene) -> Plant:
    """A block at rest on the table, the go far away from it."""
    body = Body(name="hbox", vertices=rectangle(0.12, 0.06), mass=0.5)
    plant = Plant(make_scene(extrinsic=body, extrinsic_pose=(0.4, 0.03, 0.0)))
    rest(plant, 0.2)
    return plant


def eo_of(plant: Plant) -> np.ndarray:
    assert plant.eo is not None
    return plant.eo


def pull(plant: Plant, force: float, height: float) -> None:
    """Pull the eo with a horizontal ``force`` at ``height`` above the table, and with no other."""
    lever = height - plant.data.qpos[4]
    plant.data.qfrc_applied[3:6] = force, 0.0, -force * lever


def force_that_starts(plant: Plant, height: float, has_started, stop: float) -> float:
    """Ramp the pull slowly (0.02 N/s); the force at which ``has_started`` is true, or ``stop``."""
    force = 0.9 * stop / 1.2
    while force < stop and not has_started():
        force += 0.00002
        pull(plant, force, height)
        plant.step(plant.ee_pose, REST)
    return force


# -- in free air ---------------------------------------------------------------------------------------------------


@given(
    ee=st.tuples(st.floats(-1, 1), st.floats(0.3, 1), st.floats(-3, 3)),
    grasp=st.tuples(st.floats(-0.02, 0.02), st.floats(-0.06, 0.06), st.floats(-3, 3)),
)
def test_sagged_go_is_in_balance(ee, grasp):
    stiffness = np.array([[2208.96, -143.31, 17.91], [-143.31, 1875.92, -14.05], [17.91, -14.05, 3.228]])
    x, y, angle = Coupling(stiffness, grasp, 0.1, 2e-4).sagged(ee, 9.81)
    # by hand: where the grasp is, what the fingers do there, and the moment of force and weight about it
    go_axes = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    turn = angle + grasp[2]
    axes = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    lever = go_axes @ grasp[:2]
    d = axes.T @ (np.array(ee[:2]) - (x, y) - lever)
    force_x, force_y, torque = stiffness @ np.append(d, ee[2] - turn)
    np.testing.assert_allclose(axes @ (force_x, force_y), [0.0, 0.981], atol=1e-11)
    assert torque + lever[0] * 0.981 == pytest.approx(0.0, abs=1e-12)


@given(
    ee=st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.5, 0.5)),
    centre=st.tuples(st.floats(-1, 1), st.floats(-1, 1)),
    spin=st.floats(-2, 2),
)
def test_common_rigid_motion_is_not_damped(ee, centre, spin):
    """Go and ee turn together about any point: x does not change, so only K x acts."""
    stiffness = np.array([[2208.96, -143.31, 17.91], [-143.31, 1875.92, -14.05], [17.91, -14.05, 3.228]])
    coupling = Coupling(stiffness, (0.0, 0.045, 0.2), 0.1, 2e-4)

    def twist(x, y, _angle):
        return (-spin * (y - centre[1]), spin * (x - centre[0]), spin)

    go = (0.02, -0.01, 0.3)
    still = coupling.grip(go, REST, ee, REST)
    turning = coupling.grip(go, twist(*go), ee, twist(*ee))
    np.testing.assert_allclose(turning, still, atol=1e-9)


def test_sagged_go_stays_at_rest(make_scene):
    plant = Plant(make_scene(start=(0.1, 0.3, 0.6)))
    before = plant.go
    rest(plant, 0.5)
    np.testing.assert_allclose(plant.go, before, atol=1e-12)
    np.testing.assert_allclose(plant.ground_wrench(), 0.0)
    assert plant.contacts() == ()


def test_go_follows_a_steady_ee_without_lag(make_scene):
    """The damping is fed forward: at constant velocity the fingers carry the weight and no more."""
    plant = Plant(make_scene())
    x, y, angle = plant.ee_pose
    for i in range(1, 1001):
        plant.step((x + 0.1 * i * 1e-3, y, angle), (0.1, 0.0, 0.0))
    np.testing.assert_allclose(plant.coupling_wrench()[:2], [0.0, 0.981], atol=2e-3)


def test_release_drops_the_go_and_grasp_holds_it_where_it_lies(make_scene):
    plant = Plant(make_scene(start=(0.0, 0.125, 0.0)))
    plant.release()
    rest(plant, 0.5)
    assert not plant.coupling_wrench().any()
    np.testing.assert_allclose(plant.ground_wrench(plant.go[:2]), [0.0, -0.981, 0.0], atol=1e-5)
    assert plant.grasp()
    x, y, angle = plant.ee_pose
    for i in range(1, 501):
        plant.step((x, y + 0.1 * i * 1e-3, angle), (0.0, 0.1, 0.0))
    rest(plant, 0.3)
    np.testing.assert_allclose(plant.coupling_wrench()[:2], [0.0, 0.981], atol=1e-4)


def test_fingers_that_close_on_nothing_hold_nothing(make_scene):
    plant = Plant(make_scene())
    plant.release()
    rest(plant, 0.3)
    assert not plant.grasp()
    assert not plant.coupling_wrench().any()


# -- on the table --------------------------------------------------------------------------------------------------


def test_block_sinks_in_by_micrometres_only(hbox):
    assert 0 <= 0.03 - eo_of(hbox)[1] < 3e-6
    assert abs(eo_of(hbox)[2]) < 1e-7


def test_block_stands_on_its_two_lower_corners(hbox):
    left, right = hbox.contacts()
    assert {c.on for c in (left, right)} == {"eo"} and {c.by for c in (left, right)} == {"ground"}
    np.testing.assert_allclose([left.point[0], right.point[0]], [0.34, 0.46], atol=1e-6)
    for contact in (left, right):
        np.testing.assert_allclose(contact.normal, [0.0, 1.0], atol=1e-9)
        np.testing.assert_allclose(contact.force, [0.0, WEIGHT / 2], atol=1e-4)
        assert contact.mode == "stick"


def test_table_carries_the_weight_about_any_point(hbox):
    np.testing.assert_allclose(hbox.ground_wrench((0.1, -0.3)), [0.0, -WEIGHT, -0.3 * WEIGHT], atol=1e-5)


def test_block_starts_to_slide_at_mu_times_its_weight(hbox):
    start = eo_of(hbox)[0]
    force = force_that_starts(hbox, 0.01, lambda: eo_of(hbox)[0] - start > 5e-6, 1.2 * 0.33 * WEIGHT)
    assert force / WEIGHT == pytest.approx(0.33, rel=0.01)


@pytest.mark.parametrize("direction", [-1, 1])
def test_sliding_block_feels_mu_against_its_motion(hbox, direction):
    pull(hbox, direction * 0.5 * WEIGHT, 0.01)
    rest(hbox, 0.4)
    # Newton: what friction leaves of the pull accelerates it
    assert hbox.data.qvel[3] == pytest.approx(direction * (0.5 - 0.33) * 9.81 * 0.4, rel=0.02)
    # a fast contact hops by micrometres; take a step in which it touches
    while not hbox.contacts():
        rest(hbox, 0.001)
    for contact in hbox.contacts():
        # t = n turned by −90° is +x; the table moves against the block's motion as the block sees it
        assert contact.mode == ("slip-" if direction > 0 else "slip+")
        assert contact.force[0] / contact.force[1] == pytest.approx(-direction * 0.33, rel=1e-3)


def test_block_at_nine_tenths_of_the_cone_does_not_creep(hbox):
    pull(hbox, 0.9 * 0.33 * WEIGHT, 0.01)
    rest(hbox, 0.1)
    before = eo_of(hbox)
    rest(hbox, 10.0)
    assert abs(eo_of(hbox)[0] - before[0]) < 1e-6
    assert all(contact.mode == "stick" for contact in hbox.contacts())


def test_block_tips_when_the_pull_outweighs_it(make_scene):
    body = Body(name="tower", vertices=rectangle(0.05, 0.15), mass=0.1)
    friction = {"go-ground": 0.33, "go-eo": 0.33, "eo-ground": 0.8}
    plant = Plant(make_scene(extrinsic=body, extrinsic_pose=(0.4, 0.075, 0.0), friction=friction))
    rest(plant, 0.2)
    limit = 0.1 * 9.81 * 0.025 / 0.12
    force = force_that_starts(plant, 0.12, lambda: eo_of(plant)[2] < -2e-4, 1.2 * limit)
    assert force == pytest.approx(limit, rel=0.01)


def test_non_convex_body_stands_like_any_other(make_scene):
    z = ((17.3, -63.4), (17.3, 28.8), (51.8, 28.8), (51.8, 63.4), (-17.3, 63.4), (-17.3, -28.8), (-51.8, -28.8))
    vertices = tuple((x * 1e-3, y * 1e-3) for x, y in (*z, (-51.8, -63.4)))
    plant = Plant(make_scene(extrinsic=Body(name="z", vertices=vertices, mass=0.1), extrinsic_pose=(0.4, 0.0634, 0.0)))
    rest(plant, 0.3)
    np.testing.assert_allclose(eo_of(plant), [0.4, 0.0634, 0.0], atol=5e-6)
    points = np.array([contact.point[0] - 0.4 for contact in plant.contacts()])
    pushes = np.array([contact.force[1] for contact in plant.contacts()])
    assert (points.min(), points.max()) == pytest.approx((-0.0518, 0.0173), abs=1e-5)
    assert pushes.sum() == pytest.approx(0.981, abs=1e-4)
    assert points @ pushes == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("direction", [-1, 1])
def test_go_dragged_over_the_eo_has_the_signs_of_the_convention(make_scene, direction):
    eo = Body(name="anvil", vertices=rectangle(0.2, 0.06), mass=5.0)
    plant = Plant(make_scene(extrinsic=eo, extrinsic_pose=(0.0, 0.03, 0.0), start=(0.0, 0.19, 0.3)))
    x, y, angle = plant.ee_pose
    for i in range(1, 501):
        plant.step((x, y - 0.012 * i / 500, angle), (0.0, -0.024, 0.0))
    for i in range(1, 501):
        plant.step((x + direction * 0.05 * i * 1e-3, y - 0.012, angle), (direction * 0.05, 0.0, 0.0))
    # a fast contact hops by micrometres; take a step in which it touches
    while not (pressing := [c for c in plant.contacts() if c.by == "go"]):
        x, y, angle = plant.ee_pose
        plant.step((x + direction * 0.05e-3, y, angle), (direction * 0.05, 0.0, 0.0))
    (contact,) = pressing
    assert contact.on == "eo"
    # n points down into the eo, so t is −x: a go that moves along +x moves along −t
    np.testing.assert_allclose(contact.normal, [0.0, -1.0], atol=1e-4)
    assert contact.mode == ("slip-" if direction > 0 else "slip+")
    assert contact.force[1] < -0.5
    assert contact.force[0] / -contact.force[1] == pytest.approx(direction * 0.33, rel=0.02)


def test_velocity_of_a_contact_point_is_that_of_its_body(make_scene):
    """Against the difference of where a body-fixed point is before and after one step."""
    plant = Plant(make_scene())
    plant.data.qvel[:3] = 0.3, -0.2, 2.0
    point = np.array([0.05, 0.2])
    x, y, angle = plant.go
    plant.step(plant.ee_pose, REST)
    X, Y, turned = plant.go
    c, s = np.cos(turned - angle), np.sin(turned - angle)
    moved = np.array([X, Y]) + np.array([[c, -s], [s, c]]) @ (point - (x, y))
    # the step's velocity is the new one; the point moves by half a millimetre meanwhile
    np.testing.assert_allclose(plant._velocity("go", 0.5 * (point + moved)), (moved - point) / 1e-3, atol=1e-3)


# -- health --------------------------------------------------------------------------------------------------------


def test_same_steps_give_the_same_bits(make_scene):
    def run() -> bytes:
        plant = Plant(make_scene(start=(0.0, 0.123, 0.3)))
        for i in range(1, 801):
            plant.step((1e-5 * i, 0.123 - 1e-5 * i, 0.3), (0.01, -0.01, 0.0))
            if i % 7 == 0:
                plant.contacts()
        assert plant.contacts()
        return plant.data.qpos.tobytes() + plant.coupling_wrench().tobytes() + plant.ground_wrench().tobytes()

    assert run() == run()


def test_reset_repeats_the_run(make_scene):
    plant = Plant(make_scene(start=(0.0, 0.123, 0.3)))

    def land() -> bytes:
        for i in range(1, 401):
            plant.step((0.0, 0.123 - 2e-5 * i, 0.3), (0.0, -0.02, 0.0))
        assert plant.contacts()
        return plant.data.qpos.tobytes()

    first = land()
    plant.reset()
    assert land() == first


@pytest.mark.parametrize("velocity", [np.nan, np.inf, 1e5])
def test_diverged_state_is_a_fault_until_reset(make_scene, velocity, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plant = Plant(make_scene())
    plant.data.qvel[0] = velocity
    for _ in range(2):
        with pytest.raises(DeviceFault, match="diverged") as caught:
            rest(plant, 0.01)
        assert caught.value.device == "world" and caught.value.recoverable
    plant.reset()
    rest(plant, 0.01)
    assert not list(tmp_path.iterdir()), "no log file of the physics engine lies about"


def test_ee_that_is_nowhere_is_a_fault(make_scene):
    plant = Plant(make_scene())
    with pytest.raises(DeviceFault, match="fingers push"):
        for _ in range(2):
            plant.step((np.nan, 0.0, 0.0), REST)


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"friction": {}}, "go-ground"),
        ({"start": (0.0, 0.0, 0.0)}, "go and ground overlap"),
        ({"stiffness": ((1.0, 0.0, 0.0), (0.0, -1.0, 0.0), (0.0, 0.0, 1.0))}, "smallest eigenvalue is -1"),
        ({"stiffness": ((1.0, 5.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))}, "not symmetric"),
        (
            {
                "stiffness": ((100.0, 0.0, 0.0), (0.0, 100.0, 0.0), (0.0, 0.0, 1e-3)),
                "grasp": (0.0, -0.045, 0.0),
                "start": (0.0, 0.3, 0.3),
            },
            "too soft",
        ),
        ({"extrinsic": Body(name="a", vertices=rectangle(0.1, 0.1), mass=0.1)}, "extrinsic_pose"),
        (
            {
                "extrinsic": Body(name="a", vertices=rectangle(0.1, 0.1), mass=0.1),
                "extrinsic_pose": (0.0, 0.03, 0.0),
            },
            "eo and ground overlap",
        ),
        ({"grasped": Body(name="a", vertices=((0, 0), (0.1, 0), (0, 0.1)), mass=0.1)}, "must be the centroid"),
        ({"friction": {"go-ground": 0.0}}, r"scene\.friction: 'go-ground' is 0; expected a number above 0"),
        ({"friction": {"go-ground": 0.3, "go-eo": -0.1}}, "'go-eo' is -0.1"),
        (
            {
                "extrinsic": Body(name="a", vertices=rectangle(0.1, 0.1), mass=0.1),
                "extrinsic_pose": (0.05, 0.2, 0.0),
            },
            "go and eo overlap over",
        ),
    ],
)
def test_scene_that_cannot_be_is_refused(make_scene, parts, message):
    scene: Scene = make_scene(**parts)
    with pytest.raises(ValueError, match=message):
        Plant(scene)


@pytest.mark.parametrize(("margin", "stable"), [(1.01, True), (0.99, False)])
def test_grasp_needs_the_torsional_stiffness_that_a_push_of_10_newtons_asks_for(make_scene, margin, stable):
    """A dead load F at the distance L turns the go out of fingers softer than F L, less the pendulum of its weight."""
    needed = 10.0 * np.hypot(0.025, 0.07345 + 0.045) - 0.1 * 9.81 * 0.045
    diagonal = ((2000.0, 0.0, 0.0), (0.0, 2000.0, 0.0), (0.0, 0.0, margin * needed))
    if stable:
        Plant(make_scene(stiffness=diagonal))
        return
    with pytest.raises(ValueError, match=r"scene\.stiffness: .* makes the go spin out of the grasp"):
        Plant(make_scene(stiffness=diagonal))
