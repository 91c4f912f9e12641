"""From a resolved experiment to what the layers below work with: the scene, the tags, the weight, a skill's task."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from control.observe import Finger, Observer
from control.settings import TrialSettings
from drivers.scene import Body, Scene, TagMount
from drivers.station import Devices
from estimation.contact_location import ContactLocator
from estimation.force_torque import FreeAirLoad, WristSensor
from estimation.grasp_filter import GraspFilter
from estimation.state import StateEstimator
from experiments import registries
from experiments.calibrate.models import CameraCalibration, ClockCalibration, ForceTorqueCalibration
from experiments.calibrate.store import Calibrations
from experiments.files import Resolved
from experiments.schema import ExecuteStage, PlanStage
from mechanics import se2
from mechanics.camera import CameraModel, TagGeometry
from mechanics.elasticity import Elasticity
from mechanics.readings import Array
from planning.skills.base import Held
from planning.task import Task

GRAVITY = 9.81
#: height of the grasped object above the table before the first trial [m]
START_HEIGHT = 0.03


def free_air_load(resolved: Resolved) -> FreeAirLoad:
    """The weight of the grasped object, as the wrist sensor carries it."""
    return FreeAirLoad(resolved.grasped.mass, np.zeros(2), GRAVITY)


def tags(resolved: Resolved) -> dict[str, tuple[TagGeometry, ...]]:
    """The tags of each body: ``table`` from the station, ``go`` and ``eo`` from the objects."""
    found = {"table": tuple(_geometry(mount) for mount in resolved.station.table_tags)}
    for body, shape in (("go", resolved.grasped), ("eo", resolved.extrinsic)):
        tag = None if shape is None else shape.body(body)["tag"]
        found[body] = () if tag is None else (_geometry(TagMount.model_validate(tag)),)
    return found


def _geometry(mount: TagMount) -> TagGeometry:
    return TagGeometry(mount.id, mount.size, mount.pose, mount.height)


def scene(resolved: Resolved) -> Scene:
    """The initial scene. An experiment that only calibrates begins with nothing on the table."""
    whole = every_body(resolved)
    if any(isinstance(stage, PlanStage | ExecuteStage) for stage in resolved.experiment.stages):
        return whole
    return without_extrinsic(whole)


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
    seat = calibrations.tag(resolved)
    clock = calibrations.of(ClockCalibration)
    seen = tags(resolved)
    if seat is not None:
        seen["go"] = tuple(replace(tag, pose=seat.pose) if tag.id == seat.id else tag for tag in seen["go"])
    return Believed(
        resolved.sensor.stiffness if elasticity is None else elasticity.K,
        {**resolved.friction, **{pair: found.mu for pair, found in calibrations.friction(resolved).items()}},
        None if hung is None else (hung.tool_mass, np.array(hung.tool_centre)),
        None if camera is None else camera.model,
        seen,
        {} if clock is None else {name: found.delay for name, found in clock.delays.items()},
    )


def observer(
    resolved: Resolved, devices: Devices, settings: TrialSettings, known: Believed, fingers: tuple[Finger, ...] = ()
) -> Observer:
    """The eyes of a trial: arm, wrist sensor, camera and ``fingers``, with what is known of them and a fresh grasp."""
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
            locator=ContactLocator(resolved.grasped.polygon, max(known.friction.values())),
        ),
        tactile_frames=settings.tactile_frames,
    )


def task(resolved: Resolved, stage: PlanStage, known: Believed) -> Task:
    """What the planner is asked for. Raises ValueError naming the parameter that the geometry does not allow."""
    held = Held(
        vertices=resolved.grasped.polygon.vertices,
        mass=resolved.grasped.mass,
        grasp=resolved.grasp,
        stiffness=known.stiffness,
        mu=known.friction["go-ground"],
        gravity=GRAVITY,
    )
    return registries.skills()[stage.skill].task(stage.skill_parameters, held)
