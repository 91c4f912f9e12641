"""Whatever bytes a decoder is given, it returns or raises what it says that it raises, at once and in little room.

``EXTRINSIC_FUZZ_CASES`` says how many cases each decoder meets; `make fuzz` asks for 100 000.
"""

import hashlib
import os
import time
import zlib
from pathlib import Path

import pytest
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from tests.fuzz.decoders import DECODERS
from tests.fuzz.guard import Watch
from tests.fuzz.mutation import STEPS, spoilt

CASES = int(os.environ.get("EXTRINSIC_FUZZ_CASES", "1000"))
BATCH = 1000
FOUND = Path(__file__).parent / "found"


@pytest.mark.timeout(0 if CASES > 1000 else 120)
@pytest.mark.parametrize("name", DECODERS)
def test_a_decoder_takes_any_bytes(name, capsys):
    decoder, watch = DECODERS[name], Watch()
    seeds = decoder.seeds()
    for each in seeds:
        decoder.decode(each)  # they are valid, or nothing would be tried

    def take(which, steps):
        data = spoilt(seeds, which, steps, decoder.tokens)
        try:
            with watch.one():
                decoder.decode(data)
        except decoder.errors:
            pass
        except BaseException:
            keep(name, data)
            raise

    begin = time.perf_counter()
    for batch in range(max(CASES // BATCH, 1)):

        @seed(batch or zlib.crc32(name.encode()))
        @settings(
            max_examples=min(BATCH, CASES),
            database=None,
            phases=(Phase.generate, Phase.shrink),
            suppress_health_check=(HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much),
            print_blob=False,
        )
        @given(which=st.integers(0, len(seeds) - 1), steps=STEPS)
        def take_a_batch(which, steps):
            take(which, steps)

        take_a_batch()
    if CASES > BATCH:
        with capsys.disabled():
            took = time.perf_counter() - begin
            print(  # noqa: T201
                f"\n{name}: {watch.cases} cases, {took:.0f} s, dearest {watch.seconds * 1e3:.0f} ms"
                f" and {watch.megabytes:.1f} MB"
            )


def keep(name, data):
    """Leave a case that was found, to be kept as a regression test under a name of its own."""
    folder = Path(os.environ.get("EXTRINSIC_FUZZ_FOUND", "build/fuzz")) / name
    folder.mkdir(parents=True, exist_ok=True)
    (folder / hashlib.sha1(data).hexdigest()[:12]).write_bytes(data)


def found():
    return sorted(path for path in FOUND.glob("*/*") if path.is_file())


@pytest.mark.parametrize("case", found(), ids=lambda path: f"{path.parent.name}-{path.name}")
def test_what_was_found_stays_mended(case):
    decoder = DECODERS[case.parent.name]
    try:
        with Watch().one():
            decoder.decode(case.read_bytes())
    except decoder.errors:
        pass
