"""Stage `calibrate_elasticity`: the paper's protocol. The object is fixed to the table, the fingers move about it.

The fixed object's pose comes from its tag, seen in every sample and averaged, since it does not move; the fingers'
from the arm; the wrench from the wrist sensor (Tactile Elasticity Characterization).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from drivers.errors import DeviceFault
from estimation.contact_wrench import wrist_covariance
from experiments import setup
from experiments.calibrate.rig import Rig
from experiments.calibrate.schema import ElasticityStage
from mechanics import se2, wrench
from mechanics.readings import Array
from mechanics.task_plane import TaskPlane

#: how often the fixed object is looked at
LOOKS = 20


@dataclass(frozen=True, eq=False)
class ElasticitySamples:
    """What was measured: ``x`` (n, 3) displacements of ee in gocf [m, m, rad], ``w`` (n, 3) wrenches of the sensor on
    the object about the grasp centre, in gocf [N, N, N·m], and the covariance (3, 3) of each row of ``w``."""

    x: Array
    w: Array
    w_covariance: Array


def schedule(stage: ElasticityStage, stiffness: Array, rng: np.random.Generator) -> Array:
    """Displacements (n, 3) [m, m, rad] in the order of the samples: to and fro along each axis, then at random.

    Each axis is gone through up, down and up again, so that what the membrane's hysteresis adds takes both signs.
    """
    scale = np.array([stage.force, stage.force, stage.torque]) / np.diag(stiffness)
    per_axis, rest = divmod(stage.samples // 2, 3)
    along = []
    for axis in range(3):
        count = per_axis + (axis < rest)
        if count:
            turn = np.abs((np.linspace(0, 4, count, endpoint=False) + 1) % 4 - 2) - 1  # triangle wave from 0
            along.append(-turn[:, None] * np.eye(3)[axis])
    random = rng.uniform(-1, 1, (stage.samples - sum(map(len, along)), 3))
    return np.concatenate([*along, random]) * scale


def sampled(rig: Rig, stage: ElasticityStage, rng: np.random.Generator) -> ElasticitySamples:
    """Go through the schedule and measure. Ends with the object free in the fingers again."""
    context, observer = rig.context, rig.observer
    what = context.resolved.grasped.name
    rig.regrasp(0)
    seen = observer.see(("go",))["go"]
    if seen is None:
        raise DeviceFault("camera", "see the object", "its tag is not in view", "Bring the object's tag into view")
    observer.zero(setup.free_air_load(context.resolved), seen.pose)
    rig.clamp("go", what)
    X_W_gocf = se2.compose(_looked(rig), observer.grasp)
    x, w, covariances = [], [], []
    targets = schedule(stage, context.believed.stiffness, rng)
    with context.progress.steps("elasticity samples", len(targets)) as advance:
        for target in targets:
            rig.mover.ramp(se2.compose(X_W_gocf, target), stage.ramp)
            reading, covariance = rig.wrist_samples(stage.dwell)
            ee = observer.arm_pose()
            x.append(se2.between(X_W_gocf, ee))
            on_go = observer.wrist_sensor.wrench_on_go(reading, ee, X_W_gocf[:2])
            w.append(wrench.rotated(on_go, -X_W_gocf[2]))
            covariances.append(_covariance_in_gocf(covariance, observer.wrist_sensor.X_ee_s, ee, X_W_gocf))
            advance()
    rig.mover.ramp(se2.compose(X_W_gocf, np.zeros(3)), 0.5)
    rig.free(what)
    rig.rest(0.5)
    return ElasticitySamples(np.array(x), np.array(w), np.mean(covariances, axis=0))


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
