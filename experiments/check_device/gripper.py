"""The steps of a gripper: its opening, and, on request, one cycle of it."""

from __future__ import annotations

from experiments.check_device.bench import Bench, Step
from experiments.check_device.findings import Finding, judged, skipped

#: what the fingers close with [N]
FORCE = 10.0
#: fingers are open, and closed, by so much at least [m]
CYCLE = 0.002


def _state(bench: Bench) -> Finding:
    reading, largest = bench.device.latest(), bench.describe().range
    holding = f"holding something with {reading.force:.1f} N" if reading.holding else "holding nothing"
    good = reading.width >= 0 and (not largest or reading.width <= 1.05 * largest[0])
    remedy = "Home the fingers, so that they know their opening"
    return judged(good, f"{reading.width * 1e3:.1f} mm open, {holding}", remedy, width_mm=reading.width * 1e3)


def _cycle(bench: Bench) -> Finding:
    if not bench.move:
        return skipped("it moves on request only: --move")
    if not bench.person.confirm(
        f"THE FINGERS MOVE: they open, close with {FORCE:g} N and open. Are they empty, and hands away from them?"
    ):
        return skipped("nobody agreed")
    device = bench.device
    device.release()
    wide = device.latest().width
    device.grasp(FORCE)
    closed = device.latest()
    device.release()
    again = device.latest().width
    held = "holding something" if closed.holding else "holding nothing"
    measured = f"{wide * 1e3:.1f} mm, closed {closed.width * 1e3:.1f} mm and {held}, {again * 1e3:.1f} mm"
    good = min(wide, again) - closed.width > CYCLE
    return judged(good, measured, "See what is between the fingers, and home them", closed_mm=closed.width * 1e3)


STEPS = (
    Step("opening", "how far its fingers are open: measure it", _state),
    Step("cycle", "open, close, open", _cycle, asks=True),
)
