from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from drivers.wire.lease import LeaseTable


def test_a_free_lease_goes_to_who_asks() -> None:
    table = LeaseTable(time_to_live=1.0)
    assert table.acquire("a", now=0.0)
    assert table.holder(0.5) == "a"


def test_a_held_lease_is_refused_to_others_and_granted_to_its_holder() -> None:
    table = LeaseTable(time_to_live=1.0)
    table.acquire("a", 0.0)
    assert not table.acquire("b", 0.5)
    assert table.acquire("a", 0.5)
    assert table.holder(1.4) == "a"


def test_a_lease_lapses_one_time_to_live_after_the_last_renewal() -> None:
    table = LeaseTable(time_to_live=1.0)
    table.acquire("a", 0.0)
    assert table.renew("a", 0.9)
    assert table.holder(1.8) == "a"
    assert table.holder(1.9) is None


def test_a_lapsed_lease_cannot_be_renewed() -> None:
    table = LeaseTable(time_to_live=1.0)
    table.acquire("a", 0.0)
    assert not table.renew("a", 1.0)
    assert table.acquire("b", 1.0)


def test_a_stranger_can_neither_renew_nor_release() -> None:
    table = LeaseTable(time_to_live=1.0)
    table.acquire("a", 0.0)
    assert not table.renew("b", 0.1)
    assert not table.release("b")
    assert table.holder(0.5) == "a"


def test_a_lapse_is_told_once() -> None:
    table = LeaseTable(time_to_live=1.0)
    table.acquire("a", 0.0)
    assert table.lapse(0.5) is None
    assert table.lapse(1.0) == "a"
    assert table.lapse(1.1) is None


def test_who_let_a_lease_lapse_is_known_until_it_is_taken_anew() -> None:
    table = LeaseTable(time_to_live=1.0)
    table.acquire("a", 0.0)
    assert not table.has_lapsed("a", 0.9)
    assert table.has_lapsed("a", 1.0), "before anybody looked"
    table.lapse(1.1)
    assert table.has_lapsed("a", 1.2)
    assert not table.has_lapsed("b", 1.2)
    table.acquire("a", 1.3)
    table.release("a")
    assert not table.has_lapsed("a", 1.4)


_STEP = st.tuples(
    st.sampled_from(["acquire", "renew", "release", "lapse"]), st.sampled_from("abc"), st.floats(0.0, 0.7)
)


@given(st.lists(_STEP, max_size=40))
def test_commands_of_two_holders_never_overlap(steps: list[tuple[str, str, float]]) -> None:
    """Against a model that keeps only (who, until)."""
    table, now, model = LeaseTable(time_to_live=1.0), 0.0, None
    for verb, who, wait in steps:
        now += wait
        held = model if model is not None and now < model[1] else None
        if verb == "acquire":
            granted = held is None or held[0] == who
            assert table.acquire(who, now) == granted
            model = (who, now + 1.0) if granted else model
        elif verb == "renew":
            granted = held is not None and held[0] == who
            assert table.renew(who, now) == granted
            model = (who, now + 1.0) if granted else model
        elif verb == "release":
            table.release(who)
            model = None if model is not None and model[0] == who else model
        else:
            table.lapse(now)
        held = model if model is not None and now < model[1] else None
        assert table.holder(now) == (None if held is None else held[0])
