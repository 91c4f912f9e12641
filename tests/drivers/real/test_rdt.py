"""RDT's records, status words and sequence numbers, without a network."""

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers.real import rdt
from drivers.real.rdt import Command, Record, Sequence, Verdict

WORD = 2**32


def test_a_request_is_the_eight_bytes_of_the_manual():
    assert rdt.request(Command.START) == bytes.fromhex("1234 0002 00000000")
    assert rdt.request(Command.STOP) == bytes.fromhex("1234 0000 00000000")
    assert rdt.request(Command.BIAS) == bytes.fromhex("1234 0042 00000000")
    assert rdt.request(Command.START_BUFFERED, 7) == bytes.fromhex("1234 0003 00000007")


def test_a_record_is_read_as_the_manual_lays_it_out():
    datagram = bytes.fromhex("00000001 ffffffff 80020000 00000001 ffffffff 80000000 7fffffff 00000000 fffffffe")
    counts = (1, -1, -(2**31), 2**31 - 1, 0, -2)
    assert rdt.decode(datagram) == [Record(1, WORD - 1, 0x80020000, counts)]


def test_the_records_of_one_datagram_come_oldest_first():
    rows = [struct.pack(">III6i", n, 7 * n, 0, *[n] * 6) for n in range(1, 41)]
    assert [record.rdt_sequence for record in rdt.decode(b"".join(rows), 40)] == list(range(1, 41))


@pytest.mark.parametrize("size", [0, 1, 8, 35, 37, 72, 1440, 65507])
def test_a_datagram_of_another_length_is_no_record(size):
    with pytest.raises(ValueError, match=str(size)):
        rdt.decode(bytes(size))


# -- the status word ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("word", "bad"),
    [
        (0, False),
        (0x80010000, False),  # somebody's threshold
        (0x80280002, False),  # CAN, EtherNet/IP, HTTP: other networks than this one
        (0x80020000, True),  # saturated
        (0x00020000, True),
        (0x90000000, True),
        (0x80010100, True),  # a harmless bit excuses no other
        (0x80000000, True),  # an error that it does not name
        (0x80008000, True),  # a bit that the manual does not have
        (0x00000001, True),
        (0xFFFFFFFF, True),
    ],
)
def test_a_status_word_tells_whether_the_reading_can_be_trusted(word, bad):
    assert bool(rdt.faults(word)) is bad


def test_a_status_word_is_told_by_name():
    assert rdt.told(0) == ()
    assert rdt.told(0x90000204) == (
        "analog board error",
        "strain gage excitation current too high",
        "internal temperature error",
    )
    assert rdt.told(0x80008000) == ("status bit 15",)
    assert len(rdt.told(0x80000000)) == 1
    assert all(rdt.told(1 << bit) for bit in range(32))


# -- sequences ---------------------------------------------------------------------------------------------------------


def stream(first: int, count: int, ft: int = 0) -> list[tuple[int, int]]:
    """The numbers of ``count`` records of a stream at 1 kHz."""
    return [((first + i) % WORD, (ft + 7 * i) % WORD) for i in range(count)]


@given(
    first=st.one_of(st.integers(0, WORD - 1), st.integers(WORD - 60, WORD - 1)),
    ft=st.one_of(st.integers(0, WORD - 1), st.integers(WORD - 400, WORD - 1)),
    fates=st.lists(st.sampled_from(["sent", "sent", "dropped", "twice", "behind"]), max_size=60),
)
def test_losses_duplicates_and_late_ones_are_told_apart_exactly(first, ft, fates):
    fates = ["sent", "sent", *fates, "sent", "sent"]
    arriving: list[tuple[int, int]] = []
    behind = None
    done = dict.fromkeys(("sent", "dropped", "twice", "behind"), 0)
    for numbers, wanted in zip(stream(first, len(fates), ft), fates, strict=True):
        fate = "sent" if wanted == "behind" and behind is not None else wanted
        done[fate] += 1
        if fate == "behind":
            behind = numbers
        elif fate != "dropped":
            arriving += [numbers] * (2 if fate == "twice" else 1)
            if behind is not None:
                arriving.append(behind)
                behind = None

    sequence = Sequence()
    verdicts, missing = [], 0
    for numbers in arriving:
        verdicts.append(sequence.take(*numbers))
        if verdicts[-1] is Verdict.NEXT:
            missing += sequence.step - 1

    assert verdicts[:2] == [Verdict.UNCONFIRMED, Verdict.FIRST]
    assert verdicts.count(Verdict.NEXT) == done["sent"] + done["twice"] - 2
    assert verdicts.count(Verdict.DUPLICATE) == done["twice"]
    assert verdicts.count(Verdict.LATE) == done["behind"]
    assert missing == done["dropped"] + done["behind"]
    assert len(verdicts) == 2 + sum(verdicts.count(v) for v in (Verdict.NEXT, Verdict.DUPLICATE, Verdict.LATE))


def test_a_late_record_that_comes_once_more_is_a_duplicate():
    sequence = Sequence()
    one, two, three, four = stream(1, 4)
    taken = [sequence.take(*numbers) for numbers in (one, two, four, three, three)]
    assert taken[2:] == [Verdict.NEXT, Verdict.LATE, Verdict.DUPLICATE]


def test_a_measurement_that_is_sent_again_under_a_new_number_is_told():
    sequence = Sequence()
    taken = [sequence.take(*numbers) for numbers in ((1, 0), (2, 7), (3, 7), (4, 14))]
    assert taken[1:] == [Verdict.FIRST, Verdict.REPEATED, Verdict.NEXT]


@pytest.mark.parametrize("stranger", [(2**31, 50), (50, 2**31 + 100), (WORD - 5000, 3), (1000, 100), (3, 2**30)])
def test_one_record_with_the_numbers_of_another_stream_changes_nothing(stranger):
    sequence = Sequence()
    for numbers in stream(101, 20, 1000):
        sequence.take(*numbers)
    assert sequence.take(*stranger) is Verdict.STRAY
    assert sequence.take(121, 1140) is Verdict.NEXT
    assert sequence.step == 1


# asked to start anew the box counts from 1, and goes on measuring; switched off and on it begins both anew
@pytest.mark.parametrize("ft", [71000, 7])
def test_two_in_a_row_begin_another_stream(ft):
    sequence = Sequence()
    for numbers in stream(5000, 20, 70000):
        sequence.take(*numbers)
    taken = [sequence.take(*numbers) for numbers in stream(1, 5, ft)]
    assert taken == [Verdict.STRAY, Verdict.RESTARTED, Verdict.NEXT, Verdict.NEXT, Verdict.NEXT]


def test_a_stream_that_begins_anew_where_it_just_began_is_found_again():
    sequence = Sequence()
    for numbers in stream(1, 5, 70000):
        sequence.take(*numbers)
    taken = [sequence.take(*numbers) for numbers in stream(1, 9, 7)]
    assert set(taken[:5]) == {Verdict.DUPLICATE}
    assert taken[5:] == [Verdict.STRAY, Verdict.RESTARTED, Verdict.NEXT, Verdict.NEXT]


def test_more_missing_than_can_be_is_another_stream():
    sequence = Sequence(dropout=100)
    for numbers in stream(1, 5):
        sequence.take(*numbers)
    assert sequence.take(105, 700) is Verdict.NEXT
    assert sequence.step == 100
    assert sequence.take(206, 1400) is Verdict.STRAY


@given(st.lists(st.tuples(st.integers(0, WORD - 1), st.integers(0, WORD - 1)), max_size=50))
def test_random_numbers_never_begin_a_stream(numbers):
    sequence = Sequence()
    random = [pair for i, pair in enumerate(numbers) if i == 0 or (pair[0] - numbers[i - 1][0]) % WORD != 1]
    assert {sequence.take(*pair) for pair in random} <= {Verdict.UNCONFIRMED}
