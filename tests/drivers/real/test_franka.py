"""A Franka arm, driven through libfranka's own wire protocol, against an emulated robot."""

import sys
import threading
from collections.abc import Iterator
from time import monotonic

import numpy as np
import pytest

pytest.importorskip("franky")
pytest.importorskip("franky_sim")

from drivers.emulators.franka_arm import FrankaArmEmulator
from drivers.errors import CommandRefused, DeviceFault, DriverError, NotConnected
from drivers.interfaces import ArmTarget
from drivers.real.franka import FrankaArm
from mechanics.readings import Status
from tests.drivers.real.franka_cases import FRAMES, HOME, Witness, await_that, config, connected

pytestmark = pytest.mark.alone

REST = np.zeros(3)


@pytest.fixture(scope="module")
def robot() -> Iterator[Witness]:
    witness = Witness()
    with witness.emulator:
        yield witness


@pytest.fixture
def arm(robot: Witness) -> Iterator[FrankaArm]:
    with connected(robot.emulator.host) as arm:
        arm.recover()  # whatever the test before has left
        arm.acquire("test")
        yield arm


def target(x_mm: float, y_mm: float = 0.0, seconds: float = 0.5) -> ArmTarget:
    return ArmTarget(HOME + np.array([x_mm, y_mm, 0.0]) * 1e-3, REST, seconds)


def go_home(robot: Witness, arm: FrankaArm) -> None:
    arm.command(target(0))
    robot.await_rest()


class Stream:
    """Set-points at 50 Hz of the robot's time along a straight line, at ``speed`` [m/s] along x."""

    def __init__(self, robot: Witness, arm: FrankaArm, speed: float):
        self.start, self.speed = robot.emulator.pose()[1], speed
        twist = np.array([speed, 0.0, 0.0])
        # 0.3 s to come to its speed, in which it goes half as far
        arm.command(ArmTarget(self.start + twist * 0.15, twist, 0.3))
        begun = robot.now + 0.3
        for i in range(1, 11):
            robot.await_time(begun + (i - 2) * 0.02)
            arm.command(ArmTarget(self.start + twist * (0.15 + 0.02 * i), twist, 0.02))
        self.last = self.start + twist * 0.35


def test_a_move_of_20_mm_ends_within_half_a_millimetre(robot, arm):
    go_home(robot, arm)
    arm.command(target(20, seconds=1.0))
    truth = robot.await_rest()
    error = np.hypot(*(truth - HOME - [0.02, 0, 0])[:2])
    assert error < 0.5e-3
    assert np.abs(arm.latest().pose - truth).max() < 1e-4, "the reading is where its joints are"


def test_a_circle_of_10_mm_streamed_at_50_hz_is_followed_within_one_and_a_half(robot, arm, rate=50):
    """Radius 10 mm, 4 s a turn, which is 15.7 mm/s; the error is taken at equal times of the robot."""
    go_home(robot, arm)
    radius, turn = 0.010, 2 * np.pi / 4.0

    def circle(t):
        """From rest: the turning comes up to speed within the first second."""
        t = np.clip(np.asarray(t, float), 0.0, None)
        phase = turn * np.where(t < 1, t * t / 2, t - 0.5)
        rate_of_phase = turn * np.minimum(t, 1.0)
        flat = np.zeros_like(phase)
        pose = HOME + radius * np.stack([np.cos(phase) - 1, np.sin(phase), flat], -1)
        return pose, radius * np.stack([-np.sin(phase), np.cos(phase), flat], -1) * rate_of_phase[..., None]

    begun = robot.now
    for i in range(1, 5 * rate + 1):
        robot.await_time(begun + (i - 1) / rate)
        arm.command(ArmTarget(*circle(robot.now - begun + 1 / rate), 1 / rate, i))
    times, poses = robot.since(begun + 1.0)
    times, poses = times[times < begun + 5.0], poses[times < begun + 5.0]
    errors = np.linalg.norm((poses - circle(times - begun)[0])[:, :2], axis=1)
    assert len(times) > 500
    assert errors.mean() < 1.5e-3, f"mean {errors.mean() * 1e3:.2f} mm, worst {errors.max() * 1e3:.2f} mm"


def test_stop_ends_a_motion_within_a_tenth_of_a_second_and_holds_until_recover(robot, arm):
    go_home(robot, arm)
    Stream(robot, arm, 0.05)
    asked = robot.now
    arm.stop()
    robot.await_time(asked + 0.6)
    _, poses = robot.since(asked + 0.1)
    assert np.abs(poses - poses[-1]).max() < 2e-4, "it moves no more"
    with pytest.raises(CommandRefused, match="stopped"):
        arm.command(target(0))
    arm.recover()
    go_home(robot, arm)
    assert np.abs(robot.emulator.pose()[1] - HOME).max() < 1e-3


def test_an_arm_whose_commander_falls_silent_brakes_by_itself(robot, arm):
    go_home(robot, arm)
    stream = Stream(robot, arm, 0.05)
    rest = robot.await_rest()
    # half of its speed over the time of braking, and then no further
    assert rest[0] - stream.last[0] < 0.05 * arm.config.braking / 2 + 0.5e-3
    await_that(lambda: arm.latest() and not arm._robot.is_in_control, "the motion has ended by itself")


def test_hold_brakes_at_once_and_the_next_set_point_is_taken(robot, arm):
    go_home(robot, arm)
    Stream(robot, arm, 0.05)
    asked = robot.now
    arm.hold()
    robot.await_time(asked + 0.6)
    _, poses = robot.since(asked + 0.3)
    assert np.ptp(poses, axis=0).max() < 2e-4
    go_home(robot, arm)
    assert np.abs(robot.emulator.pose()[1] - HOME).max() < 1e-3


@pytest.mark.parametrize("moving", [False, True], ids=["at rest", "in motion"])
def test_a_reflex_refuses_moves_until_recover(robot, arm, moving):
    go_home(robot, arm)
    if moving:
        arm.command(target(30, seconds=2.0))
        robot.await_time(robot.now + 0.3)
    robot.emulator.reflex()
    await_that(lambda: arm._mode == "Reflex", "the driver has seen it")
    before = robot.await_rest()
    with pytest.raises(CommandRefused, match="Reflex: cartesian_reflex"):
        arm.command(target(0))
    assert np.abs(robot.emulator.pose()[1] - before).max() < 1e-4
    arm.recover()
    go_home(robot, arm)
    assert np.abs(robot.emulator.pose()[1] - HOME).max() < 1e-3


def test_a_robot_in_reflex_can_be_connected_and_recovered(robot, arm):
    go_home(robot, arm)
    arm.close()
    robot.emulator.reflex()
    robot.await_time(robot.now + 0.1)
    arm.connect()
    arm.acquire("test")
    with pytest.raises(CommandRefused, match="Reflex"):
        arm.command(target(0))
    arm.recover()
    go_home(robot, arm)
    assert np.abs(arm.latest().pose - HOME).max() < 1e-3


def test_commands_need_the_lease_and_one_commander_holds_it(robot, arm):
    arm.acquire("test")  # its holder may ask again
    with pytest.raises(CommandRefused, match="'test' holds the lease"):
        arm.acquire("another")
    arm.release()
    arm.release()
    with pytest.raises(CommandRefused, match="no lease"):
        arm.command(target(0))
    arm.acquire("another")


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (ArmTarget(np.array([np.nan, 0, 0]), REST, 0.1), "not finite"),
        (ArmTarget(HOME, np.array([np.inf, 0, 0]), 0.1), "not finite"),
        (ArmTarget(HOME[:2], REST, 0.1), "must be \\(3,\\)"),
        (ArmTarget(HOME, REST, 0.0), "must be positive"),
        (ArmTarget(HOME, np.array([2.0, 0, 0]), 0.1), "speed of 2 m/s, the robot is set to"),
    ],
)
def test_a_set_point_that_makes_no_sense_is_refused(arm, wrong, said):
    with pytest.raises(CommandRefused, match=said):
        arm.command(wrong)


def test_readings_come_at_the_rate_by_the_robots_clock_and_every_lost_one_is_counted(robot, arm):
    start, begun = arm.latest().stamp, arm.robot_time
    await_that(lambda: arm.robot_time > begun + 1.0, "a second of the robot's has passed")
    stamps = [reading.stamp for reading in arm.since(start.capture_ns)]
    numbers = np.array([start.sequence, *(stamp.sequence for stamp in stamps)])
    assert (np.diff(numbers) >= 1).all()
    assert (np.diff([stamp.capture_ns for stamp in stamps]) > 0).all()
    assert abs((numbers[-1] - numbers[0]) / arm.config.rate - (arm.robot_time - begun)) < 0.05
    assert all(stamp.status is Status.OK and stamp.frame == "world" for stamp in stamps)
    first = arm._readings[0].stamp.sequence
    lost = arm._readings[-1].stamp.sequence - first + 1 - len(arm._readings)
    assert abs(arm.gaps - lost) <= 1, "what is missing by its number is what was counted"  # one may come meanwhile


def test_the_joints_say_where_the_arm_cannot_be(arm):
    """A Franka Research 3 reaches 0.855 m from its shoulder, which is 0.333 m above its base (data sheet)."""
    assert arm.reachable(HOME) == ""
    assert arm.reachable(HOME + np.array([0.05, -0.1, 0.5])) == ""
    # the wrist's centre is no further than 0.35 m from ee: nothing 1.3 m from the shoulder can be reached
    assert "reach" in arm.reachable(np.array([0.8, 0.333, 0.0])) or "joint" in arm.reachable(
        np.array([0.8, 0.333, 0.0])
    )
    assert arm.reachable(np.array([0.0, 0.3, -1.7])).startswith("the arm cannot be there: joint")


def test_an_arm_out_of_the_plane_is_not_commanded_and_its_readings_are_invalid(robot, arm):
    arm.close()
    with connected(robot.emulator.host, plane={"origin": (0.5, 0.02, 0.0)}) as off:
        off.acquire("test")
        assert off.latest().stamp.status is Status.INVALID
        with pytest.raises(CommandRefused, match=r"20\.0 mm and .* out of the task plane"):
            off.command(target(0))


def test_a_second_client_is_refused_and_the_first_goes_on(robot, arm):
    second = FrankaArm("second", config(robot.emulator.host))
    with pytest.raises(
        NotConnected, match=f"second: connect to {robot.emulator.host}:1337: no answer within 1 s"
    ) as told:
        second.connect(1.0)
    assert "one client at a time" in told.value.remedy
    assert np.abs(arm.latest().pose - robot.emulator.pose()[1]).max() < 1e-3
    await_that(lambda: "guarded call" not in [t.name for t in threading.enumerate()], "nothing is left waiting")
    arm.close()
    second.connect()
    second.close()


def test_nobody_there_is_told_at_once_with_the_address():
    arm = FrankaArm("arm", config("127.0.66.66"))
    with pytest.raises(NotConnected, match=r"connect to 127\.0\.66\.66:1337: Connection .*refused"):
        arm.connect(2.0)
    assert not arm.connected


def test_a_missing_package_is_told_with_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "franky", None)
    with pytest.raises(NotConnected, match=r"pip install 'extrinsic\[franka\]'"):
        FrankaArm("arm", config("127.0.66.66")).connect(1.0)


def test_it_describes_itself_alike_open_and_closed(robot):
    closed = FrankaArm("arm", config(robot.emulator.host)).describe()
    with connected(robot.emulator.host) as arm:
        assert arm.describe() == closed


def test_a_closed_arm_takes_no_commands():
    arm = FrankaArm("arm", config("127.0.66.66"))
    for ask in (arm.hold, arm.stop, arm.recover, lambda: arm.acquire("me"), lambda: arm.command(target(0))):
        with pytest.raises(NotConnected):
            ask()
    arm.close()
    arm.close()


def fault_within(arm: FrankaArm, seconds: float) -> None:
    """The robot has gone just now: a reading tells so as a DeviceFault."""
    gone = monotonic()
    with pytest.raises(DeviceFault, match="arm: read"):
        while monotonic() < gone + 5.0:
            try:
                arm.latest(0.1)
            except DeviceFault:
                raise
            except DriverError:
                continue
    assert monotonic() - gone < seconds


def test_a_robot_that_dies_in_motion_is_a_fault_within_1500_ms_and_is_reached_again_by_itself():
    first = Witness()
    with first.emulator:
        arm = FrankaArm("arm", config(first.emulator.host))
        arm.connect()
        arm.acquire("test")
        arm.command(target(20, seconds=2.0))
        first.await_time(first.now + 0.3)
        last = arm.latest().stamp
        first.emulator.kill()
        fault_within(arm, 1.5)
        with pytest.raises(DriverError):
            arm.command(target(0))
    second = Witness(first.emulator.host)
    with second.emulator:
        await_that(lambda: arm.reconnections == 1 and arm.trouble is None, "it is reached again")
        assert np.abs(arm.latest(2.0).pose - HOME).max() < 1e-3
        stamps = [reading.stamp for reading in arm.since(last.capture_ns)]
        assert (np.diff([last.sequence, *(stamp.sequence for stamp in stamps)]) > 0).all()
        with pytest.raises(CommandRefused, match="no lease"):  # who commanded it does not know where it is
            arm.command(target(5))
        arm.acquire("test")
        arm.command(target(5))
        assert np.abs(second.await_rest() - HOME - [0.005, 0, 0]).max() < 0.5e-3
        arm.close()


def test_a_robot_that_hangs_is_a_fault_and_neither_a_command_nor_closing_hangs_with_it():
    witness = Witness()
    with witness.emulator:
        arm = FrankaArm("arm", config(witness.emulator.host))
        arm.connect()
        arm.acquire("test")
        arm.command(target(20, seconds=2.0))
        witness.await_time(witness.now + 0.3)
        witness.emulator.freeze()
        fault_within(arm, 1.5)
        begun = monotonic()
        for ask in (lambda: arm.command(target(0)), arm.hold, arm.stop, arm.recover):
            with pytest.raises(DriverError):
                ask()
        arm.close()
        assert monotonic() - begun < 12.0
        await_that(lambda: "guarded call" not in [t.name for t in threading.enumerate()], "nothing is left waiting")
        with pytest.raises(NotConnected, match=r"no answer within 0\.5 s"):
            arm.connect(0.5)


def test_two_emulated_robots_cannot_have_one_address(robot):
    with pytest.raises(NotConnected, match=robot.emulator.host), FrankaArmEmulator(FRAMES, host=robot.emulator.host):
        pass
