"""The steps of a force/torque sensor: noise, tare, and which way it takes a push."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.spatial.transform import Rotation

from experiments.check_device.bench import MOMENT, Bench, Step
from experiments.check_device.findings import Finding, judged, skipped
from mechanics.readings import Array

AXES = ("fx", "fy", "fz", "tx", "ty", "tz")
#: more noise than this at rest is none of the sensor's [N, N·m]; a tare leaves less than that
NOISE, ZERO = (0.5, 0.05), (0.5, 0.05)
#: a push is one from here on [N]
PUSH = 2.0
#: the cosine of the largest angle between a hand's push and the direction that was asked for
_ALONG = 0.8
#: in the axes of `mechanics.readings.WrenchReading`: X right, Y away from the viewer, Z up
DIRECTIONS: dict[str, tuple[float, float, float]] = {
    "down": (0.0, 0.0, -1.0),
    "to the right": (1.0, 0.0, 0.0),
    "away from the viewer": (0.0, 1.0, 0.0),
}


def _wrenches(bench: Bench, seconds: float = MOMENT) -> Array:
    return bench.gather(lambda reading: reading.wrench, seconds)


def _noise(bench: Bench) -> Finding:
    spread = _wrenches(bench).std(axis=0)
    limits = np.repeat(NOISE, 3)
    told = ", ".join(f"{axis} {value:.2g}" for axis, value in zip(AXES, spread, strict=True))
    dead = [axis for axis, value in zip(AXES, spread, strict=True) if value == 0]
    if dead and bench.config.backend != "sim":  # an ideal world has no noise
        return judged(False, f"{', '.join(dead)} never changes; {told}", "An axis is dead: see to transducer and cable")
    remedy = "Let nothing touch it; see to the box's low-pass filter, and to its cable's shield"
    return judged(bool((spread <= limits).all()), f"{told} (N, N·m; 1 sigma)", remedy, sigma=_by_axis(spread))


def _load(bench: Bench) -> Finding:
    load = _wrenches(bench).mean(axis=0)
    said = f"{np.linalg.norm(load[:3]):.2f} N and {np.linalg.norm(load[3:]):.3f} N·m before the tare"
    largest = bench.describe().range
    if len(largest) == len(AXES) and (np.abs(load) > 0.9 * np.array(largest)).any():
        return judged(False, f"{said}: near the end of its range", "Take the load away, or bias the box")
    return judged(True, said, wrench=_by_axis(load))


def _tare(bench: Bench) -> Finding:
    question = "Others may be reading this sensor, and its zero changes for them too. Tare it?"
    if bench.opened.shared and not bench.person.confirm(question):
        return skipped("others may be reading it, and nobody agreed")
    bench.device.tare()
    left = _wrenches(bench).mean(axis=0)
    force, torque = float(np.linalg.norm(left[:3])), float(np.linalg.norm(left[3:]))
    measured = f"{force:.3f} N and {torque:.4f} N·m are left"
    return judged(force <= ZERO[0] and torque <= ZERO[1], measured, "Let nothing touch it, and tare again")


def _pushes(bench: Bench) -> Finding:
    if not bench.person.here:
        return skipped("it needs a hand")
    on_wrist = getattr(bench.config, "mount", "wrist") == "wrist"
    what = "the tool, with the end-effector at angle 0," if on_wrist else "the table's top"
    turn = _planar_turn(float(getattr(bench.config, "pose", (0, 0, 0))[2]))
    rest = _wrenches(bench).mean(axis=0)[:3]
    said, felt, meant, wrong = list[str](), list[Array](), list[Array](), False
    for words, direction in DIRECTIONS.items():
        if not bench.person.ready(f"Push {what} {words} by hand, with about 10 N, and keep pushing"):
            continue
        push = np.median(_wrenches(bench, 2 * MOMENT), axis=0)[:3] - rest  # a hand takes a moment
        size, expected = float(np.linalg.norm(push)), turn @ np.array(direction)
        cosine = float(push @ expected) / size if size else 0.0
        what_came = f"{_axis(push)} {size:.1f} N" if size >= PUSH else f"nothing, {size:.1f} N"
        said.append(f"{words}: {what_came}, expected {_axis(expected)}")
        felt.append(push / size if size >= PUSH else np.full(3, np.nan))
        meant.append(expected)
        wrong = wrong or size < PUSH or cosine < _ALONG
    if not said:
        return skipped("no push was made")
    return judged(not wrong, "; ".join(said), _remedy(bench, np.array(felt), np.array(meant)) if wrong else "")


def _planar_turn(angle: float) -> Array:
    """(3, 3) from axes that are parallel to W's into a sensor's frame that is turned by a planar ``angle``."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _axis(vector: Array) -> str:
    """The axis along which most of it lies, with its sign."""
    i = int(np.abs(vector).argmax())
    return f"{'-' if vector[i] < 0 else '+'}{AXES[i]}"


def _remedy(bench: Bench, felt: Array, meant: Array) -> str:
    """What would set the axes right; known only after a push along each."""
    if not np.isfinite(felt).all():
        return f"Push harder, with {PUSH:g} N at least"
    turned = getattr(bench.config, "rotation_deg", None)
    if turned is None or len(felt) < len(DIRECTIONS):
        return "See how the sensor is mounted, and the frame that its readings are to have: docs/deploy.md"
    U, _, Vt = np.linalg.svd(meant.T @ felt)
    Q = U @ Vt
    mirrored = bool(np.linalg.det(Q) < 0)
    R = (-Q if mirrored else Q) @ Rotation.from_euler("xyz", turned, degrees=True).as_matrix()
    with warnings.catch_warnings():  # where two of the turns are about one axis, any of their sums will do
        warnings.simplefilter("ignore", UserWarning)
        angles = Rotation.from_matrix(R).as_euler("xyz", degrees=True)
    rounded = [float(5 * round(angle / 5)) + 0.0 for angle in angles]
    upside = bool(getattr(bench.config, "reversed", False)) != mirrored
    return f"What was felt fits rotation_deg: {rounded}, reversed: {str(upside).lower()}; push once more with it"


def _by_axis(values: Array) -> dict[str, float]:
    return dict(zip(AXES, values.tolist(), strict=True))


STEPS = (
    Step("noise", "nothing touches it, nothing moves: each axis' scatter", _noise),
    Step("load", "what it carries, and whether that is within its range", _load),
    Step("tare", "the zero after a tare", _tare, asks=True),
    Step("push", "which axis a push moves, and its sign (docs/conventions.md)", _pushes),
)
