"""A Franka hand against an emulated one, with a block between its fingers and with none."""

from collections.abc import Iterator
from time import monotonic

import pytest

pytest.importorskip("franky")
pytest.importorskip("franky_sim")

from drivers.emulators.franka_arm import FrankaArmEmulator
from drivers.errors import CommandRefused, DriverError, NotConnected
from drivers.real.franka_hand import FrankaHand, FrankaHandConfig
from tests.drivers.real.franka_cases import FRAMES, HOME

pytestmark = pytest.mark.alone

WIDTH = 0.03


def hand_at(host: str, **given: object) -> FrankaHand:
    entry = {"kind": "gripper", "backend": "real", "driver": "franka_hand", "host": host, "speed": 0.05, **given}
    return FrankaHand("hand", FrankaHandConfig.model_validate(entry))


@pytest.fixture(scope="module")
def robot() -> Iterator[FrankaArmEmulator]:
    with FrankaArmEmulator(FRAMES, HOME, block=WIDTH) as emulator:
        yield emulator


def test_it_holds_a_block_by_its_width_and_lets_it_go(robot):
    with hand_at(robot.host) as hand:
        hand.grasp(20.0)
        held = hand.latest()
        assert held.holding and held.force == 20.0
        assert abs(held.width - WIDTH) < 2e-3  # MuJoCo's contacts give way a little
        hand.release()
        opened = hand.latest()
        assert not opened.holding and opened.force == 0.0
        assert abs(opened.width - 0.08) < 2e-3
        numbers = [reading.stamp.sequence for reading in hand.since(0)]
        assert numbers == sorted(set(numbers))


def test_fingers_that_close_on_nothing_hold_nothing():
    with FrankaArmEmulator(FRAMES, HOME, opening=0.02) as empty:
        hand = hand_at(empty.host)
        with hand:
            hand.grasp(20.0)
            closed = hand.latest()
            assert not closed.holding and closed.force == 0.0 and closed.width < 1e-3
            empty.kill()
            gone = monotonic()
            with pytest.raises(DriverError):
                while monotonic() < gone + 5.0:
                    hand.latest(1.4)
            assert monotonic() - gone < 2.0
            with pytest.raises(DriverError):
                hand.grasp(20.0)


@pytest.mark.parametrize("force", [0.0, -1.0, 71.0, float("nan"), float("inf")])
def test_a_force_that_it_does_not_have_is_refused(robot, force):
    with hand_at(robot.host) as hand, pytest.raises(CommandRefused, match=r"in \(0, 70\] N"):
        hand.grasp(force)


def test_it_describes_itself_alike_open_and_closed(robot):
    closed = hand_at(robot.host).describe()
    with hand_at(robot.host) as hand:
        assert hand.describe() == closed
    assert closed.range == (0.08, 70.0)


def test_nobody_there_is_told_with_the_address():
    with pytest.raises(NotConnected, match=r"connect to 127\.0\.66\.66:1338"):
        hand_at("127.0.66.66").connect(2.0)


def test_a_closed_hand_takes_no_commands():
    for ask in (lambda hand: hand.grasp(10.0), lambda hand: hand.release()):
        with pytest.raises(NotConnected):
            ask(hand_at("127.0.66.66"))
