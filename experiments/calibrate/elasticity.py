"""Stage `calibrate_elasticity`: the paper's protocol. The object is fixed to the table, the fingers move about it.

The fixed object's pose comes from its tag, seen often before the samples, since it does not move; the fingers'
from the arm; the wrench from the wrist sensor (Tactile Elasticity Characterization).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.errors import DeviceFault
from estimation.contact_wrench import wrist_covariance
from estimation.elasticity_fit import fit_elasticity
from estimation.finger_memory import Path, size
from experiments import setup
from experiments.calibrate import store
from experiments.calibrate.models import ElasticityCalibration, Matrix3, vector3
from experiments.calibrate.rig import Rig, at_hand
from experiments.calibrate.samples import save_samples
from experiments.calibrate.schema import ElasticityStage
from experiments.calibrate.threads import one_thread
from experiments.context import RunContext
from mechanics import se2, wrench
from mechanics.readings import Array
from mechanics.task_plane import TaskPlane

#: how often the fixed object is looked at
LOOKS = 20
#: how far a via point lies off, as a share of the amplitudes, and which holds are long ones
VIA, LONG = 0.5, 20
#: how many creep times the longest holds should last: in shorter ones slower creep is not told from stiffness
HELD = 1.5
#: the shortest displacement along an axis, as a share of its amplitude: a shorter one is mostly noise
SHORTEST = 0.5
#: what a tare leaves of the wrist sensor's drift while the samples are taken, 1 sigma [N, N, N·m]
DRIFT = (0.02, 0.02, 0.004)
#: the polynomial in time that it may follow has one order for so many seconds, up to the most: one that bends faster
#: would follow the creep instead, which would pass for stiffness
DRIFT_TIME, MOST_ORDERS = 65.0, 8
#: how well the arm repeats itself, 1 sigma of a hold [m, m, rad]: what the makers of such arms warrant. The fit begins
#: with it; how well this arm does shows in the residuals
POSE_NOISE = (1e-4, 1e-4, np.radians(0.1))


@dataclass(frozen=True, eq=False)
class ElasticitySamples:
    """What was measured: ``x`` (n, 3) displacements of ee in gocf [m, m, rad], ``w`` (n, 3) wrenches of the sensor on
    the object about the grasp centre, in gocf [N, N, N·m], each with ``w_covariance`` (3, 3), at ``times`` (n,) [s] in
    the ``holds`` (n,); and the ``path`` that the fingers were sent along from the grasp on."""

    x: Array
    w: Array
    w_covariance: Array
    times: Array
    holds: Array
    path: Path


def elasticity_stage(context: RunContext, stage: ElasticityStage) -> None:
    """Identify K and keep it. Raises FitError where the samples do not tell."""
    resolved = context.resolved
    rng = np.random.default_rng([resolved.experiment.seed, 1])
    with at_hand(context, f"the elasticity of {resolved.sensor.name}") as rig:
        samples = sampled(rig, stage, rng)
        rig.home()
        devices = tuple(d.name for d in (rig.devices.arm, rig.devices.force_torque("wrist"), rig.devices.camera))
    with context.progress.step("fit the elasticity"), one_thread():
        drifting = samples.w_covariance + np.diag(DRIFT) ** 2
        fit = fit_elasticity(
            samples.x,
            samples.w,
            x_covariance=np.diag(POSE_NOISE) ** 2,
            w_covariance=drifting,
            times=samples.times,
            path=samples.path,
            holds=samples.holds,
            drift_order=drift_order(float(np.ptp(samples.times))),
            pose_noise_from_residuals=True,
        )
    if warning := too_short(stage.long_dwell, fit.memory.creep_time):
        context.event("warning", warning)
    amplitude = float(np.sqrt(np.mean(size(fit.stiffness, samples.x - fit.offset) ** 2)))
    found = ElasticityCalibration(
        origin=store.origin(resolved, devices, ("go",), context.folder.path.name),
        sensor=resolved.sensor.name,
        stiffness=_rows(fit.secant(amplitude)),
        deviation=_rows(fit.secant_errors(amplitude)),
        amplitude=amplitude,
        initial=_rows(fit.stiffness),
        stiffening=fit.stiffening,
        hysteresis=fit.memory.hysteresis,
        yield_length=fit.memory.yield_length,
        creep=fit.memory.creep,
        creep_time=fit.memory.creep_time,
        offset=vector3(fit.offset),
        residual=vector3(fit.residual_rms),
        chi2=fit.chi2,
        method=fit.method,
        samples=fit.samples,
    )
    seen = samples.x - fit.offset  # to first order, what x is from gocf
    columns = {**dict(zip(("x", "y", "theta"), seen.T, strict=True))}
    columns |= dict(zip(("fx", "fy", "tau"), samples.w.T, strict=True))
    columns |= dict(zip(("fx_fit", "fy_fit", "tau_fit"), fit.wrench(seen).T, strict=True))
    save_samples(context, found.name, {"time": samples.times, **columns})
    context.calibrated(found)


def too_short(long_dwell: float, creep_time: float) -> str:
    """What to say where the longest holds [s] are too short for the creep that was found [s], or nothing."""
    if long_dwell >= HELD * creep_time:
        return ""
    found = f"the fingers creep with a time of {creep_time:.2g} s"
    return f"{found}, and in holds of {long_dwell:g} s slower creep passes for stiffness: lengthen `long_dwell`"


def drift_order(span: float) -> int:
    """The order of the polynomial that the wrist sensor's drift may follow in ``span`` seconds."""
    return int(np.clip(round(span / DRIFT_TIME), 1, MOST_ORDERS))


def _rows(matrix: Array) -> Matrix3:
    return vector3(matrix[0]), vector3(matrix[1]), vector3(matrix[2])


def amplitudes(stage: ElasticityStage, stiffness: Array) -> Array:
    """The largest displacements (3,) [m, m, rad] of the stage's holds, by the (3, 3) ``stiffness`` that is believed."""
    usual, most = (stage.force, stage.force, stage.torque), (stage.most_force, stage.most_force, stage.most_torque)
    least = np.array([stage.least_mm * 1e-3, stage.least_mm * 1e-3, np.radians(stage.least_deg)])
    return np.maximum(usual / np.diag(stiffness), np.minimum(least, most / np.diag(stiffness)))


def shares(samples: int, rng: np.random.Generator) -> Array:
    """The holds (n, 3) over the amplitudes of x, y and θ: a third along one axis, the rest at random, in mixed order.

    Along each axis they are at least `SHORTEST`, or nothing.
    """
    held = rng.uniform(SHORTEST, 1, (samples, 3)) * rng.choice((-1, 1), (samples, 3))
    axial = np.arange(samples // 3)
    held[axial] *= np.eye(3)[axial % 3]
    return rng.permutation(held)


def schedule(stage: ElasticityStage, stiffness: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """Displacements (n, 3) [m, m, rad] of the holds in their order, and the via point (n, 3) before each.

    The via points take every side, so that what the membrane remembers does not go with where it is.
    """
    scale = amplitudes(stage, stiffness)
    holds = shares(stage.samples, rng) * scale
    direction = rng.standard_normal(holds.shape)
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return holds, holds + VIA * direction * scale


def sampled(rig: Rig, stage: ElasticityStage, rng: np.random.Generator) -> ElasticitySamples:
    """Go through the schedule and measure. Ends with the object free in the fingers again.

    The displacements lie about where the fingers are when the object is fixed, which is where it hangs in them freely:
    about the grasp that was meant, an object that lies otherwise in the fingers would be pushed much harder one way.
    """
    context, observer, clock = rig.context, rig.observer, rig.devices.clock
    what = context.resolved.grasped.name
    rig.regrasp(0)
    seen = observer.see(("go",))["go"]
    if seen is None:
        raise DeviceFault("camera", "see the object", "its tag is not in view", "Bring the object's tag into view")
    observer.zero(setup.free_air_load(context.resolved), seen.pose)
    way = [(clock.now_ns(), rig.mover.pose)]
    rig.clamp("go", what)
    free = rig.mover.pose
    X_W_gocf = se2.compose(_looked(rig), observer.grasp)
    x, w, covariances, times, numbers = [], [], [], [], []
    holds, vias = schedule(stage, context.believed.stiffness, rng)

    def move(target: Array) -> None:
        way.append((clock.now_ns(), rig.mover.pose))
        rig.mover.ramp(se2.compose(free, target), stage.ramp)
        way.append((clock.now_ns(), rig.mover.pose))

    def read(number: int) -> None:
        reading, covariance = rig.wrist_samples(stage.dwell / 3)
        times.append(clock.now_ns() * 1e-9 - stage.dwell / 6)
        ee = observer.arm_pose()
        x.append(se2.between(X_W_gocf, ee))
        on_go = observer.wrist_sensor.wrench_on_go(reading, ee, X_W_gocf[:2])
        w.append(wrench.rotated(on_go, -X_W_gocf[2]))
        covariances.append(_covariance_in_gocf(covariance, observer.wrist_sensor.X_ee_s, ee, X_W_gocf))
        numbers.append(number)

    with context.progress.steps("elasticity samples", len(holds)) as advance:
        for number, (via, hold) in enumerate(zip(vias, holds, strict=True)):
            move(via)
            move(hold)
            read(number)
            rig.rest((stage.long_dwell if number % LONG == LONG - 1 else stage.dwell) - 2 * stage.dwell / 3)
            read(number)
            advance()
    way.append((clock.now_ns() + 1, rig.mover.pose))
    rig.mover.ramp(free, 0.5)
    rig.free(what)
    rig.rest(0.5)
    held = np.array(numbers)
    both = np.array(x)
    for number in range(len(holds)):  # one displacement a hold, by all that was seen of it
        both[held == number] = both[held == number].mean(axis=0)
    return ElasticitySamples(
        both, np.array(w), np.mean(covariances, axis=0), np.array(times), held, _path(way, X_W_gocf)
    )


def _path(way: list[tuple[int, Array]], X_W_gocf: Array) -> Path:
    """The set-points as displacements in gocf; where two fall on one instant the later one stands."""
    points = dict(way)
    instants = sorted(points)
    poses = np.array([points[t] for t in instants])
    return Path(np.array(instants) * 1e-9, se2.between(np.broadcast_to(X_W_gocf, poses.shape), poses))


def _looked(rig: Rig) -> Array:
    """X_W_go (3,) of the fixed object, the mean of many looks."""
    poses = [found.pose for _ in range(LOOKS) if (found := rig.observer.see(("go",))["go"]) is not None]
    if not poses:
        raise DeviceFault("camera", "see the object", "its tag is not in view", "Bring the object's tag into view")
    return np.mean(poses, axis=0)


def _covariance_in_gocf(covariance: Array, X_ee_s: Array, X_W_ee: Array, X_W_gocf: Array) -> Array:
    """The covariance (3, 3) of the wrench in gocf from that (6, 6) of the wrist's reading."""
    to_planar = TaskPlane().wrench_to_planar(np.eye(6)).T
    about = wrist_covariance(to_planar @ covariance @ to_planar.T, se2.compose(X_W_ee, X_ee_s), X_W_gocf[:2])
    turned = wrench.rotated(np.eye(3), -X_W_gocf[2]).T
    return turned @ about @ turned.T
