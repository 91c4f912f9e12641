"""From a resolved experiment to what the layers below work with: the scene, the tags, the weight, the observer."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from control.observe import Finger, Observer
from control.reads import Reads
from control.settings import TrialSettings
from control.witness import TableWitness
from drivers.config import ForceTorqueConfig
from drivers.errors import DriverError
from drivers.roles import Roles
from drivers.scene import Body, Scene, TagMount
from estimation.contact_filter import ContactFilter
from estimation.contact_location import ContactLocator
from estimation.contact_tracking import ContactTracker
from estimation.contact_wrench import EnvironmentWrench
from estimation.force_torque import FreeAirLoad, WristSensor
from estimation.grasp_filter import GraspFilter
from estimation.state import StateEstimator
from experiments.calibrate.models import CameraCalibration, ClockCalibration, ForceTorqueCalibration
from experiments.calibrate.store import Calibrations
from experiments.files import Resolved
from mechanics import se2
from mechanics.camera import CameraModel, TagGeometry
from mechanics.elasticity import Elasticity
from mechanics.readings import Array

GRAVITY = 9.81
#: height of the grasped object above the table before the first trial [m]
START_HEIGHT = 0.03
#: the contact is looked for with so much more friction than believed: a µ too small costs millimetres, one too large
#: next to nothing
MU_ROUNDED_UP = 1.1


def free_air_load(resolved: Resolved) -> FreeAirLoad:
    """The weight of the grasped object, as the wrist sensor carries it."""
    return FreeAirLoad(resolved.grasped.mass, np.zeros(2), GRAVITY)


def tags(resolved: Resolved) -> dict[str, tuple[TagGeometry, ...]]:
    """The tags of each body: ``table`` from the station, ``go`` and ``eo`` from the objects."""
    found = {"table": tuple(_geometry(mount) for mount in resolved.station.table_tags)}
    for body, shape in (("go", resolved.grasped), ("eo", resolved.extrinsic)):
        mounts = () if shape is None else Body.model_validate(shape.body(body)).tags
        found[body] = tuple(_geometry(mount) for mount in mounts)
    return found


def _geometry(mount: TagMount) -> TagGeometry:
    return TagGeometry(mount.id, mount.size, mount.pose, mount.height)


def scene(resolved: Resolved, X_W_eo: tuple[float, float, float] | None = None) -> Scene:
    """The grasped object in the fingers, and the extrinsic one at ``X_W_eo``; without that the table is empty.

    A run begins with an empty table; what a trial needs there is put there before it.
    """
    whole = every_body(resolved)
    if X_W_eo is None or whole.extrinsic is None:
        return without_extrinsic(whole)
    top = float(se2.transform(np.array(X_W_eo), np.array(whole.extrinsic.vertices))[:, 1].max())
    x, y, theta = whole.start
    return whole.model_copy(update={"extrinsic_pose": X_W_eo, "start": (x, y + top, theta)})


def without_extrinsic(scene: Scene) -> Scene:
    """The scene with the grasped object alone."""
    friction = {"go-ground": scene.friction["go-ground"]}
    return scene.model_copy(update={"extrinsic": None, "extrinsic_pose": None, "friction": friction})


def every_body(resolved: Resolved) -> Scene:
    """The grasped object upright in the fingers, clear of the table, and the extrinsic one, nobody says where."""
    lowest = float(resolved.grasped.polygon.vertices[:, 1].min())
    upright = np.array([0.0, START_HEIGHT - lowest, 0.0])
    carried = free_air_load(resolved).wrench_on_go(upright, se2.compose(upright, resolved.grasp)[:2])
    start = Elasticity(resolved.sensor.stiffness).ee_pose(upright, resolved.grasp, carried)
    bodies = {
        role: None if shape is None else Body.model_validate(shape.body(role))
        for role, shape in (("go", resolved.grasped), ("eo", resolved.extrinsic))
    }
    return Scene.model_validate(
        {
            "grasped": bodies["go"],
            "extrinsic": bodies["eo"],
            "grasp": resolved.grasp.tolist(),
            "stiffness": resolved.sensor.stiffness.tolist(),
            "friction": resolved.friction,
            "start": start.tolist(),
            "gravity": GRAVITY,
        }
    )


@dataclass(frozen=True, eq=False)
class Believed:
    """What planner, controllers and estimators take for true: as calibrated, else as catalogue and station say.

    ``stiffness`` (3, 3) K in gocf, ``friction`` by pair, ``tool`` mass [kg] and centre (2,) in ee [m], ``camera``, and
    the ``tags`` of each body: ``table``, ``go``, ``eo``. None: as the device describes it. ``delays`` [s] of the
    streams behind the arm's.
    """

    stiffness: Array
    friction: dict[str, float]
    tool: tuple[float, Array] | None
    camera: CameraModel | None
    tags: dict[str, tuple[TagGeometry, ...]]
    delays: dict[str, float]


def believed(resolved: Resolved, calibrations: Calibrations) -> Believed:
    """What a run believes that knows these calibrations."""
    elasticity = calibrations.elasticity(resolved)
    hung = calibrations.of(ForceTorqueCalibration)
    camera = calibrations.of(CameraCalibration)
    seats = calibrations.tags(resolved)
    clock = calibrations.of(ClockCalibration)
    seen = tags(resolved)
    seen["go"] = tuple(replace(tag, pose=seats[tag.id].pose) if tag.id in seats else tag for tag in seen["go"])
    return Believed(
        resolved.sensor.stiffness if elasticity is None else elasticity.K,
        {**resolved.friction, **{pair: found.mu for pair, found in calibrations.friction(resolved).items()}},
        None if hung is None else (hung.tool_mass, np.array(hung.tool_centre)),
        None if camera is None else camera.model,
        seen,
        {} if clock is None else {name: found.delay for name, found in clock.delays.items()},
    )


def go_pose(resolved: Resolved, calibrations: Calibrations) -> Literal["tags", "tactile"]:
    """Where a run that knows these calibrations lets its controllers learn the go's pose from (``trial.go_pose``)."""
    asked = resolved.experiment.trial.go_pose
    if asked != "auto":
        return asked
    return "tactile" if has_fingers(resolved) and calibrations.elasticity(resolved) is not None else "tags"


def has_fingers(resolved: Resolved) -> bool:
    """Whether the station has tactile fingers."""
    return any(device.kind == "tactile" for device in resolved.station.devices.values())


def contact_tracker(resolved: Resolved, known: Believed) -> ContactTracker:
    """What follows the contact of a fresh grasp: the go's outline among ground and extrinsic object, friction as known.

    The same seed gives the same answers.
    """
    mu = {pair: MU_ROUNDED_UP * value for pair, value in known.friction.items()}
    on_go = max(value for pair, value in mu.items() if "go" in pair.split("-"))
    locator = ContactLocator(resolved.grasped.polygon, on_go, only_near=True)
    particles = ContactFilter(locator, np.random.default_rng(resolved.experiment.seed))
    return ContactTracker(particles, mu, None if resolved.extrinsic is None else resolved.extrinsic.polygon)


def warm_up(resolved: Resolved, known: Believed, fingers: tuple[Finger, ...] = (), reads: Reads | None = None) -> None:
    """Estimate once what trials estimate: the first time on a machine compiles for seconds, and no arm may wait then.

    A finger that fails is left for the trial to name. The fingers are read by ``reads``.
    """
    wrench = EnvironmentWrench.of([0.0, 10.0, 0.0], np.diag([0.1, 0.1, 0.01]), np.zeros(2))
    go = np.array([0.0, resolved.grasped.polygon.bounding_radius, 0.0])
    contact_tracker(resolved, known).at(0, go, np.zeros((3, 3)), None, wrench)
    prior = GraspFilter(resolved.grasp).predicted(0, np.zeros(3))
    for finger in fingers:
        with suppress(DriverError):
            finger.method.estimate((reads or Reads()).capture(finger.sensor), prior)


def _witness(resolved: Resolved, devices: Roles, settings: TrialSettings) -> TableWitness | None:
    """The sensor under the table, where the station has one."""
    mounts = [d.mount for d in resolved.station.devices.values() if isinstance(d, ForceTorqueConfig)]
    if mounts.count("table") != 1:
        return None
    sensor, eo = devices.force_torque("table"), resolved.extrinsic
    return TableWitness(
        sensor,
        np.array(sensor.describe().extra["pose"], float),
        resolved.grasped.mass * GRAVITY,
        0.0 if eo is None else eo.mass * GRAVITY,
        round(settings.window * 1e9),
    )


def observer(
    resolved: Resolved, devices: Roles, settings: TrialSettings, known: Believed, fingers: tuple[Finger, ...] = ()
) -> Observer:
    """The eyes of a trial: arm, wrist sensor, camera and ``fingers``, with what is known of them and a fresh grasp.

    Without ``fingers`` the state takes the go's pose from its tag.
    """
    wrist = devices.force_torque("wrist")
    said = wrist.describe().extra
    tool = said.get("tool", {"mass": 0.0, "centre": (0.0, 0.0)})
    mass, centre = known.tool or (tool["mass"], np.array(tool["centre"], float))
    camera = known.camera or CameraModel.from_dict(devices.camera.describe().extra["camera"])
    wrist_sensor = WristSensor(np.array(said["pose"], float), np.zeros(3), mass, centre, GRAVITY)
    return Observer(
        arm=devices.arm,
        wrist=wrist,
        camera=devices.camera,
        camera_model=camera,
        tags=known.tags,
        wrist_sensor=wrist_sensor,
        grasp=resolved.grasp,
        window_ns=round(settings.window * 1e9),
        frames=settings.tag_frames,
        fingers=fingers,
        state=StateEstimator(
            GraspFilter(resolved.grasp),
            Elasticity(known.stiffness),
            wrist_sensor,
            free_air_load(resolved),
            settings.window,
            delays=known.delays,
            contact=contact_tracker(resolved, known),
        ),
        tactile_frames=settings.tactile_frames,
        witness=_witness(resolved, devices, settings),
    )
