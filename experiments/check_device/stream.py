"""The steps of every kind: what the device says of itself, and whether its stream is as it was declared."""

from __future__ import annotations

import numpy as np

from drivers.interfaces import freshness
from experiments.check_device.bench import EMPTY, SPAN, Bench, Step
from experiments.check_device.findings import Finding, judged

#: less than this share of the declared rate is too little, more than this is another device's
SLOWEST, FASTEST = 0.9, 1.1
#: the share of different values of a sensor that lives: each has noise
LIVELY = 0.2


def _describe(bench: Bench) -> Finding:
    said = bench.describe()
    words = [said.model, f"serial {said.serial or 'unknown'}", f"frame {said.frame}", f"{said.rate:g} Hz"]
    if address := said.extra.get("address"):
        words.append(f"at {address}")
    known = getattr(bench.opened.backend, "box", None)  # what a force/torque box says of itself
    if known is not None:
        words.append(f"the device itself says {known.product}, serial {known.serial}, firmware {known.firmware}")
        if not bench.config.serial:
            words.append("name that `serial` in the station file: then no other is taken for it")
    right = said.kind == bench.config.kind
    measured = "; ".join(words) if right else f"it says that it is a {said.kind}"
    return judged(right, measured, "Correct `kind` in the station file", serial=said.serial, model=said.model)


def _rate(bench: Bench) -> Finding:
    heard, declared = bench.heard(), bench.describe().rate
    if not heard.stamps:
        nothing = f"nothing came in {SPAN:g} s; {declared:g} Hz are declared"
        return judged(False, nothing, "See its power and cable")
    # in so short a time one reading more or less is no sign
    spare = 1.0 / heard.seconds
    good = SLOWEST * declared - spare <= heard.rate <= FASTEST * declared + spare
    remedy = "Set `rate` to what the device is set to, or the device to `rate`; see the network's and machine's load"
    return judged(good, f"{heard.rate:.4g} Hz; {declared:g} Hz are declared", remedy, rate_Hz=heard.rate)


def _age(bench: Bench) -> Finding:
    from experiments.context import CLOCKS, LATENCY

    heard = bench.heard()
    if not heard.stamps:
        return judged(False, "nothing came", "See the step before")
    usual, oldest, newest = float(np.median(heard.ages)), float(heard.ages.max()), float(heard.ages.min())
    fresh = min(LATENCY, freshness(bench.config.rate) or LATENCY)
    measured = (
        f"{usual * 1e3:.1f} ms as a rule, {oldest * 1e3:.1f} ms at most; as a rule {fresh * 1e3:g} ms are allowed"
    )
    remedy = "See the load of network and machine; where clocks differ by as much, see to chrony or PTP"
    if newest < -CLOCKS:
        measured = f"a reading comes {-newest * 1e3:.1f} ms before it was measured"
        remedy = "The clocks of both machines disagree: see to chrony or PTP"
    good = newest >= -CLOCKS and usual <= fresh
    return judged(good, measured, remedy, age_ms=usual * 1e3, oldest_ms=oldest * 1e3)


def _gaps(bench: Bench) -> Finding:
    heard = bench.heard()
    measured = f"{heard.gaps} lost and {heard.corrupt} damaged of {len(heard.stamps) + heard.gaps}"
    good = heard.gaps == heard.corrupt == 0 and bool(heard.stamps)
    return judged(good, measured, "See to its cable and the network", lost=heard.gaps, damaged=heard.corrupt)


def _values(bench: Bench) -> Finding:
    heard = bench.heard()
    count = len(set(heard.prints))
    if len(heard.prints) < 3:
        return judged(False, f"{len(heard.prints)} readings came", "See the step before")
    if heard.statuses:
        told = ", ".join(f"{many} {name}" for name, many in heard.statuses.items())
        return judged(False, f"{told} of {len(heard.prints)}", "See what the device itself shows", **heard.statuses)
    # a camera that sees no tag has nothing that could change, nor have the sensors of an ideal world
    good = count > LIVELY * len(heard.prints) or heard.prints[0] == EMPTY or bench.config.backend == "sim"
    return judged(good, f"{count} different ones of {len(heard.prints)}", "The value is stuck: switch it off and on")


STREAM = (
    Step("describe", "is it the device that you mean?", _describe),
    Step("rate", f"readings per second, over {SPAN:g} s", _rate),
    Step("age", "how old a reading is when it arrives", _age),
    Step("gaps", "what was lost or damaged on the way", _gaps),
    Step("values", "whether they live, and the device trusts them", _values),
)
