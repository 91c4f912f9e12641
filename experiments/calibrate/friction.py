"""Stage `calibrate_friction`: random strokes in contact, and the cone that their forces fill (the paper's protocol).

Every pair is measured by the sensor under the table, and by the one at the wrist where its tool has been weighed. For
`go-eo` the extrinsic object is fixed to the table; for `eo-ground` it is taken into the fingers instead of the grasped
one, and dragged.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from drivers.scene import Scene
from estimation.errors import FitError
from estimation.friction_fit import GAIN_ERROR, fit_friction
from estimation.friction_gain import gain_sensitivity, shares
from experiments import setup
from experiments.calibrate import store
from experiments.calibrate.models import FrictionCalibration
from experiments.calibrate.rig import Rig, at_hand
from experiments.calibrate.samples import save_samples
from experiments.calibrate.schema import FrictionStage
from experiments.calibrate.strokes import Dragged, Dragging, drawn, stroked, witnesses
from experiments.calibrate.threads import one_thread
from experiments.context import RunContext
from mechanics.catalogue import ObjectModel
from mechanics.readings import Array

#: how far the table reaches to either side of where it is used [m]
TABLE_HALF = 0.1
#: a face steeper than this [rad] is not stood on from above
STEEPEST = np.radians(50.0)
#: what is left of a sensor's zero that is taken before and after each stroke, 1 sigma [N]
TARED = 0.02
#: what a sensor leaves of the coefficient besides its gains, relative, 1 sigma
STROKES_ERROR = 0.003
#: free space between the objects while they are put into place [m]
ROOM = 0.03


def friction_stage(context: RunContext, stage: FrictionStage) -> None:
    """Identify the coefficient of ``stage.pair`` and keep it. Raises FitError where the forces do not tell."""
    resolved = context.resolved
    rng = np.random.default_rng([resolved.experiment.seed, len(stage.pair)])
    with at_hand(context, f"the friction of {stage.pair}") as rig:
        dragged = _arranged(rig, stage)
        length = min(stage.stroke_mm * 1e-3, 1.6 * dragged.half)
        tilt = (float(np.radians(stage.tilt_deg[0])), float(np.radians(stage.tilt_deg[1])))
        found: list[Dragging] = []
        strokes = drawn(rng, stage.strokes, tilt, stage.force, length)
        with context.progress.steps(f"strokes of {stage.pair}", len(strokes)) as advance:
            for stroke in strokes:
                found.append(stroked(rig, dragged, stroke, stage.speed))
                advance()
        _restored(rig, stage)
        rig.home()
        sensors = tuple(witness.sensor.name for witness in witnesses(rig))
    samples, strokes_of, gain_error = _joined(found)
    with one_thread():
        fit = fit_friction(samples, zero_error=TARED, gain_error=gain_error, strokes=strokes_of)
    roles = tuple(body for body in stage.pair.split("-") if body != "ground")
    kept = FrictionCalibration(
        origin=store.origin(resolved, sensors, roles, context.folder.path.name),
        pair=stage.pair,
        mu=fit.mu,
        interval=fit.interval,
        samples=fit.samples,
    )
    save_samples(context, kept.name, {"f_n": samples[:, 0], "f_t": samples[:, 1]})
    context.calibrated(kept)


def _joined(found: list[Dragging]) -> tuple[Array, NDArray[np.intp], float]:
    """Forces (n, 2) = (f_n, f_t) of all witnesses as one, the stroke (n,) of each, and what no sample shows.

    Each is believed by how little its gains can turn the forces as it lies. The last is relative: 1 sigma of an axis's
    gain that would leave as much of the coefficient as the witnesses' gains, and all that they leave besides, do.
    """
    ratios = [np.median(one.forces[:, :, 1] / one.forces[:, :, 0]) for one in found if one.forces.shape[1]]
    angles = np.array([one.angles for one in found if one.forces.shape[1]])
    turned = np.array([gain_sensitivity(ratio, angle) for ratio, angle in zip(ratios, angles, strict=True)])
    share, left = shares(turned.mean(axis=0), GAIN_ERROR, STROKES_ERROR)
    strokes = np.repeat(np.arange(len(found)), [one.forces.shape[1] for one in found])
    samples = np.concatenate([np.tensordot(share, one.forces, 1) for one in found])
    return samples, strokes, left / np.sqrt(2)


def _arranged(rig: Rig, stage: FrictionStage) -> Dragged:
    """Put the objects of the pair into place and say what is dragged over what."""
    resolved = rig.context.resolved
    eo = resolved.extrinsic
    if stage.pair == "go-ground":
        rig.regrasp(1)
        return _dragged(rig, resolved.grasped, resolved.grasp, np.zeros(3), TABLE_HALF)
    assert eo is not None  # the experiment's model has seen to it
    if stage.pair == "eo-ground":
        rig.lift_to(rig.start[1] + eo.polygon.bounding_radius)
        rig.rearrange(held_scene(setup.every_body(resolved)), f"Take {eo.name} into the fingers, at its middle")
        return _dragged(rig, eo, np.zeros(3), np.zeros(3), TABLE_HALF)
    X_W_eo = standing(eo)
    face, half = top_face(eo, X_W_eo)
    hangs = resolved.grasped.polygon.bounding_radius + float(np.hypot(*resolved.grasp[:2]))
    rig.lift_to(2 * eo.polygon.bounding_radius + hangs + ROOM)
    scene = setup.every_body(resolved).model_copy(update={"extrinsic_pose": tuple(X_W_eo.tolist())})
    rig.rearrange(scene, f"Put {eo.name} onto the table under the fingers, upright")
    rig.clamp("eo", eo.name)
    return _dragged(rig, resolved.grasped, resolved.grasp, face, half)


def _restored(rig: Rig, stage: FrictionStage) -> None:
    resolved = rig.context.resolved
    if stage.pair == "go-ground":
        return
    highest = 2 * max(s.polygon.bounding_radius for s in (resolved.grasped, resolved.extrinsic) if s is not None)
    rig.lift_to(rig.start[1] + highest)
    if stage.pair == "go-eo" and resolved.extrinsic is not None:
        rig.free(resolved.extrinsic.name)
    rig.rearrange(
        setup.without_extrinsic(setup.every_body(resolved)), f"Take {resolved.grasped.name} into the fingers alone"
    )


def _dragged(rig: Rig, shape: ObjectModel, grasp: Array, X_W_face: Array, half: float) -> Dragged:
    return Dragged(
        shape.polygon.vertices, grasp, shape.mass, rig.context.believed.stiffness, X_W_face, half, setup.GRAVITY
    )


def held_scene(scene: Scene) -> Scene:
    """The scene with the extrinsic object in the fingers, at its middle, and nothing else on the table."""
    assert scene.extrinsic is not None
    friction = {"go-ground": scene.friction["eo-ground"]}
    changes = {"grasped": scene.extrinsic, "grasp": (0.0, 0.0, 0.0), "friction": friction}
    return setup.without_extrinsic(scene).model_copy(update=changes)


def standing(shape: ObjectModel) -> Array:
    """X_W_B (3,) of an object that stands upright at x = 0."""
    return np.array([0.0, -float(shape.polygon.vertices[:, 1].min()), 0.0])


def top_face(shape: ObjectModel, X_W_B: Array) -> tuple[Array, float]:
    """A frame X_W_face (3,) in the middle of the face that is best stood on from above, and half that face's length.

    Raises FitError for an object without a face that looks upward.
    """
    polygon = shape.polygon.transformed(X_W_B)
    after = np.roll(polygon.vertices, -1, axis=0)
    middles, lengths = (polygon.vertices + after) / 2, np.linalg.norm(after - polygon.vertices, axis=1)
    slopes = np.arctan2(-polygon.normals[:, 0], polygon.normals[:, 1])
    up = np.flatnonzero(np.abs(slopes) < STEEPEST)
    if not len(up):
        raise FitError("a face to drag over", "one that looks upward", f"none on {shape.name}", "Stand it otherwise.")
    best = up[np.lexsort((-lengths[up], -np.round(middles[up, 1], 4)))[0]]
    return np.array([*middles[best], slopes[best]]), float(lengths[best] / 2)
