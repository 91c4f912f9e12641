"""What the identifications of finger and friction reach on data of the simulated lab, method beside method.

The data come from the plant's own membrane and the lab's own electronics, without a station: the finger is driven
through a protocol, the wrist sensor on its lever reads digits, a pose comes with white noise.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from drivers.sim.force_torque import Electronics
from drivers.sim.membrane import Membrane, MembraneSpring
from drivers.sim.mismatch import ForceTorqueFigures, Lab, load_profile
from estimation.elasticity_fit import METHODS, fit_elasticity
from estimation.finger_memory import Path, size
from estimation.friction_fit import baselines, fit_friction
from experiments.bench.figures import Figure, figure_of
from experiments.calibrate.elasticity import shares
from mechanics import se2
from mechanics.catalogue import load_sensor
from mechanics.readings import Array
from mechanics.wrench import about, rotated

#: from the grasp centre up to the wrist sensor [m]
LEVER = 0.2
#: how often the session is stepped and the sensor read [Hz]
RATE = 20.0
#: readings of which a sample is the mean
WINDOW = 10
#: the length of a via-point's distance along x, y [m] and θ [rad]
UNITS = np.array([0.001, 0.001, np.radians(1.3)])
#: how far the protocol goes along x, y [m] and θ [rad]
AMPLITUDE = np.array([0.003, 0.003, np.radians(4.0)])


@dataclass(frozen=True, eq=False)
class Session:
    """One run of the elasticity protocol, in the nominal gocf, and the truth behind it, which no fit may see.

    ``x``, ``w`` (n, 3), ``times`` and ``holds`` (n,) are the samples, two readings a hold, ``path`` the set-points;
    ``true_x`` (n, 3) is in the true gocf, ``K`` and ``membrane`` are the plant's.
    """

    x: Array
    w: Array
    times: Array
    holds: Array
    path: Path
    true_x: Array
    K: Array
    membrane: Membrane

    def secant(self, amplitude: float) -> Array:
        """The plant's secant stiffness (3, 3) at rest."""
        return (1 + self.membrane.stiffening * amplitude) * self.K

    def wrench(self, x: Array) -> Array:
        """The plant's wrench at rest (..., 3) in the true gocf."""
        return (1 + self.membrane.stiffening * size(self.K, x))[..., None] * (x @ self.K)


def session(
    nominal: Array,
    seed: int,
    *,
    samples: int = 200,
    pose_noise: float = 0.15,
    profile: str = "lab",
    membrane: Membrane | None = None,
    move: float = 0.5,
    dwell: float = 1.5,
    long_dwell: float = 25.0,
    every: int = 20,
    approach: float = 1.5,
    amplitude: Array = AMPLITUDE,
    held: Array | None = None,
    ideal_sensor: bool = False,
) -> Session:
    """Drive a finger of ``nominal`` stiffness (3, 3) through the protocol in a lab of ``seed``.

    ``pose_noise`` is 1 sigma [mm and °] of a measured pose; each move takes ``move`` [s], and the sensor is read in
    the last fifth of ``dwell`` [s], at least 0.2 s.
    """
    figures = load_profile(profile)
    lab, rng = Lab(figures, seed), np.random.default_rng([seed, 7])
    membrane = figures.membrane if membrane is None else membrane
    K = lab.stiffness(nominal)
    spring = MembraneSpring(K, membrane)
    offset = lab.grasp_offset(seed)
    repeat = figures.arm.repeatability.si
    sensor = Electronics(ForceTorqueFigures() if ideal_sensor else figures.force_torque, RATE, rng)
    targets = shares(samples, rng) * amplitude if held is None else held
    dt, t, at = 1 / RATE, 0.0, np.zeros(3)

    def read(x: Array) -> Array:
        f = np.array(spring.wrench(*x.tolist()))
        spring.advance(dt)
        fx, fy, tau = _shifted(f, offset)
        load = np.array([-fx, 0.0, -fy, 0.0, tau + LEVER * fx, 0.0])  # −τ about the sensor, in its axes
        digits = sensor.read(load)[0]
        fx, fy = -digits[0], -digits[2]
        return np.array([fx, fy, digits[4] - LEVER * fx])

    zero = np.mean([read(at) for _ in range(100)], axis=0)
    t += 100 * dt
    path, rows = [(0.0, np.zeros(3)), (t, np.zeros(3))], []
    for number, target in enumerate(targets):
        away = rng.standard_normal(3)
        for goal, stay in (
            (target + approach * away / np.linalg.norm(away) * UNITS, 0.1),
            (target, long_dwell if number % every == every - 1 else dwell),
        ):
            truly = goal + repeat * rng.standard_normal(3)
            for k in range(steps := round(move / dt)):
                read(at + (truly - at) * (k + 1) / steps)
            at, t = truly, t + steps * dt
            path.append((t, goal))
            readings = np.array([read(at) for _ in range(round(stay / dt))])
            path.append((t + len(readings) * dt, goal))
            if goal is target:
                for window in (slice(0, WINDOW), slice(-WINDOW, None)):
                    middle = t + dt * (0.5 + np.arange(len(readings))[window].mean())
                    rows.append((number, middle, at, readings[window].mean(axis=0) - zero))
            t += len(readings) * dt
    holds, times, true_x, w = (np.array(column) for column in zip(*rows, strict=True))
    noise = np.array([pose_noise * 1e-3, pose_noise * 1e-3, np.radians(pose_noise)])
    x = _nominal(offset, true_x) + (noise * rng.standard_normal((len(targets), 3)))[holds]
    at_times, points = (np.array(column) for column in zip(*path, strict=True))
    return Session(x, w, times, holds, Path(at_times, _nominal(offset, points)), true_x, K, membrane)


def _nominal(offset: Array, x: Array) -> Array:
    return se2.compose(np.broadcast_to(offset, x.shape), x)


def _shifted(w: Array, offset: Array) -> Array:
    """A wrench in the true gocf as the nominal one has it, where the true one lies at ``offset``."""
    return about(rotated(w, offset[2]), offset[:2], np.zeros(2))


def soft_bubble_stiffness() -> Array:
    """K (3, 3) in SI units of the shipped Soft Bubble."""
    return _shipped("soft_bubble")


def gel_stiffness() -> Array:
    """K (3, 3) in SI units of the shipped GelSlim."""
    return _shipped("gelslim")


def _shipped(name: str) -> Array:
    return np.asarray(load_sensor(name).stiffness, float)


def elasticity(seeds: int = 4, pose_noises: tuple[float, ...] = (0.1, 0.2)) -> Iterator[Figure]:
    """Mean error of K's diagonal [%] and time of a fit [ms], by method and pose noise, then with the path's memory."""
    for nominal, finger in ((soft_bubble_stiffness(), "Soft Bubble"), (gel_stiffness(), "GelSlim")):
        for noise in pose_noises:
            runs = [session(nominal, seed, pose_noise=noise) for seed in range(seeds)]
            covariance = np.diag([noise * 1e-3, noise * 1e-3, np.radians(noise)]) ** 2
            for method in (*METHODS, "with path"):
                errors, times = [], []
                for run in runs:
                    begin = time.perf_counter()
                    fit = (
                        fit_elasticity(run.x, run.w, x_covariance=covariance, method=method)
                        if method != "with path"
                        else fit_elasticity(
                            run.x,
                            run.w,
                            x_covariance=covariance,
                            w_covariance=np.diag([0.02, 0.02, 0.004]) ** 2,
                            times=run.times,
                            path=run.path,
                            holds=run.holds,
                            drift_order=8,
                            pose_noise_from_residuals=True,
                        )
                    )
                    times.append(1e3 * (time.perf_counter() - begin))
                    amplitude = float(np.sqrt(np.mean(size(run.K, run.true_x) ** 2)))
                    ratio = np.diag(fit.secant(amplitude)) / np.diag(run.secant(amplitude))
                    errors.append(100 * float(np.mean(np.abs(ratio - 1))))
                name = f"{finger} K, {method.replace('_', ' ')}, pose ±{noise:g} mm and °"
                yield figure_of(name, errors, "%", "mean error of the diagonal, plant's secant stiffness, 200 holds")
                yield figure_of(f"{name}: time", times, "ms")


def contact_forces(
    rng: np.random.Generator, mu: float = 0.33, samples: int = 1000, slipping: float = 0.4, outliers: float = 0.02
) -> Array:
    """Forces (n, 2) = (f_n, f_t) [N] of a contact in random motion as a tared sensor of the lab has them."""
    normal = rng.uniform(0.3, 8.0, samples)
    kind = rng.choice(3, samples, p=[slipping, 1 - slipping - outliers, outliers])
    ratio = np.choose(
        kind, [mu * rng.choice((-1, 1), samples), mu * rng.uniform(-1, 1, samples), rng.uniform(-2, 2, samples)]
    )
    force = np.column_stack([normal, ratio * normal])
    figures = load_profile("lab").force_torque
    gain = 1 + figures.gain_error * rng.standard_normal(2)
    zero = figures.drift_force * rng.standard_normal(2)
    return force * gain + zero + figures.noise[0] * rng.standard_normal(force.shape)


def friction(seeds: int = 20, mu: float = 0.33) -> Iterator[Figure]:
    """Error [%] of each method over seeds of the lab, and how often the interval covers."""
    errors: dict[str, list[float]] = {}
    covered, times = [], []
    for seed in range(seeds):
        force = contact_forces(np.random.default_rng(seed), mu)
        begin = time.perf_counter()
        fit = fit_friction(force)
        times.append(1e3 * (time.perf_counter() - begin))
        covered.append(100.0 * (fit.interval[0] <= mu <= fit.interval[1]))
        for name, value in {"maximum likelihood": fit.mu, **baselines(force)}.items():
            errors.setdefault(name, []).append(100 * abs(value / mu - 1))
    for name, values in errors.items():
        yield figure_of(f"µ, {name}", values, "%", "error, 1000 forces, 2 % outliers")
    share = float(np.mean(covered))
    yield Figure("µ, interval covers", share, share, share, "%", seeds, "share of labs, 95 % interval")
    yield figure_of("µ: time", times, "ms")
