"""The simulated world in one process: the plant, the devices around it, and the time that all of them share."""

from __future__ import annotations

import time
from collections.abc import Callable
from math import inf
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike

from drivers.config import StationConfig, TactileConfig, WorldConfig
from drivers.errors import CommandRefused, DeviceFault
from drivers.fault import Fault
from drivers.interfaces import Device, Sensor
from drivers.scene import Scene, TagMount
from drivers.sim.arm import SimArm
from drivers.sim.device import Simulated
from drivers.sim.faults import Faults, Faulty
from drivers.sim.finger import FingerView
from drivers.sim.force_torque import SimForceTorque
from drivers.sim.gripper import SimGripper
from drivers.sim.mismatch import Lab, load_profile, stream
from drivers.sim.plant import ZERO, Plant
from drivers.sim.screen import FINGER_HALF_SIZE, Screen
from mechanics import se2
from mechanics.camera import rigid
from mechanics.readings import Array, Stamp, TruthReading
from mechanics.tag_board import TagBoard
from mechanics.yaml_input import Document, InputError, Refusal, parse


def _tag_camera(name: str, config: Any, world: World) -> Device:
    # the detector behind the camera is heavy; a station without a camera goes without it
    from drivers.sim.tag_camera import SimTagCamera

    return SimTagCamera(name, config, world)


def _tactile(name: str, config: Any, world: World) -> Device:
    if config.sensor == "soft_bubble":
        from drivers.sim.soft_bubble import SimSoftBubble

        return SimSoftBubble(name, config, world)
    from drivers.sim.gelslim import SimGelSlim

    return SimGelSlim(name, config, world)


#: how to make each kind of simulated device
KINDS: dict[str, Callable[[str, Any, World], Device]] = {
    "arm": SimArm,
    "gripper": SimGripper,
    "force_torque": SimForceTorque,
    "tag_camera": _tag_camera,
    "tactile": _tactile,
}


class World:
    """The plant, its devices and their clock. It is itself the station's `Clock` and `Simulation`.

    Time is a whole number of plant steps, counted from 0 at each reset (from the Unix time of the reset for a
    realtime world, whose owner paces it). Until the first reset there is no scene: devices describe themselves, and
    everything that needs the scene raises DeviceFault. One thread owns a world; nothing here locks.
    """

    def __init__(self, config: StationConfig):
        """Raises ValueError for a station without a world, an unknown profile, or two arms."""
        if config.world is None:
            raise ValueError(f"station '{config.name}': it has no simulated world; give it a `world:` section")
        self.config = config
        self._set_world(config.world)
        self.lab = Lab(self.profile, 0)
        self._timestep = config.world.timestep
        self._timestep_ns = round(self._timestep * 1e9)
        self.lockstep = config.world.clock == "lockstep"
        self._plant: Plant | None = None
        self._origin_ns = self._steps = self._owed_ns = 0
        self.devices: dict[str, Device] = {
            name: KINDS[device.kind](name, device, self) for name, device in config.devices.items()
        }
        arms = [device for device in self.devices.values() if isinstance(device, SimArm)]
        if len(arms) > 1:
            raise ValueError(f"devices: a simulated world has one arm, not {', '.join(arm.name for arm in arms)}")
        self._arm = arms[0] if arms else None
        self._sensors = tuple(device for device in self.devices.values() if isinstance(device, Simulated))
        self.faults = Faults({name: d.line for name, d in self.devices.items() if isinstance(d, Faulty)})

    def _set_world(self, world: WorldConfig) -> None:
        try:
            self.profile = load_profile(world.profile)
        except InputError as error:
            raise ValueError(str(error)) from None
        self._stiffness_scale = world.stiffness_scale
        self._friction_scale: dict[str, float] = dict(world.friction_scale)  # type: ignore[arg-type]
        self._faults = world.faults

    # -- Clock ---------------------------------------------------------------------------------------------------

    @property
    def timestep_ns(self) -> int:
        """Length of a plant step [ns]."""
        return self._timestep_ns

    def now_ns(self) -> int:
        """Present instant [ns] since the reset, or in Unix time for a realtime world."""
        return self._origin_ns + self._steps * self._timestep_ns

    def sleep(self, seconds: float) -> None:
        """Let ``seconds`` pass: in this process the same as `advance`."""
        self.advance(seconds)

    def advance(self, seconds: float) -> int:
        """Step the world through ``seconds``; returns the steps taken.

        What does not fill a step is kept for the next call. Raises SimulationDiverged when the plant has
        diverged, DeviceFault while there is no scene, ValueError for a time that is negative or not finite.
        """
        self._need_life("advance")
        plant = self.plant("world", "advance")
        if not 0 <= seconds < 1e6:
            raise ValueError(f"world: cannot advance by {seconds} s; expected a finite time that is not negative")
        self._owed_ns += round(seconds * 1e9)
        steps, self._owed_ns = divmod(self._owed_ns, self._timestep_ns)
        dt, arm, sensors = self._timestep, self._arm, self._sensors
        for _ in range(steps):
            if arm is None:
                plant.step(plant.ee_pose, ZERO)
            else:
                arm.advance(dt)
                plant.step(arm.true_pose, arm.true_twist)
            self._steps += 1
            if self.faults.next_ns <= self.now_ns():
                self.faults.update(self.now_ns())
                self._need_life("advance")
            for sensor in sensors:
                sensor.sample()
        return steps

    # -- faults --------------------------------------------------------------------------------------------------

    def inject(self, fault: Fault | dict) -> None:
        """Let a fault happen; its times count from now. Raises CommandRefused for one that cannot be here."""
        try:
            fault = fault if isinstance(fault, Fault) else parse(Fault, Document(fault, {}, "fault"))
            fault.suit({name: device.kind for name, device in self.config.devices.items()})
        except (InputError, Refusal) as error:
            problem = error.problems[0] if isinstance(error, InputError) else error
            expected = f"Expected is {problem.expected}" if problem.expected else "Correct the fault"
            near = f"; nearest is {problem.nearest}" if problem.nearest else ""
            raise CommandRefused("world", "inject a fault", problem.wrong, expected + near) from None
        self.faults.inject(fault, self.now_ns())

    def clear_faults(self) -> None:
        """End every fault; a device that has gone is back, and has to be closed and connected again."""
        self.faults.clear(self.now_ns())

    def _need_life(self, asked: str) -> None:
        if self.faults.crashed:
            raise DeviceFault("world", asked, "the simulated world has crashed", "Start the station again")

    # -- Simulation ----------------------------------------------------------------------------------------------

    def reset(self, seed: int, scene: Scene | dict, world: WorldConfig | None = None, begin_ns: int = 0) -> None:
        """Put ``scene`` into its initial state; ``world`` replaces profile, stiffness scale and faults.

        The plant differs from the scene by what the profile comes to for ``seed``; the go lies in the fingers as the
        scene says until `regrasp`.

        Devices stay as connected, leased and stopped as they were, the arm rests at the scene's start, tares are
        undone, and every stream starts again at 0: its first reading comes one period later. In lockstep time starts
        at ``begin_ns``, and faults count from 0. Raises ValueError (pydantic's among them) for a scene that cannot be;
        the world is then as it was.
        """
        scene = scene if isinstance(scene, Scene) else Scene.model_validate(scene)
        self._need_life("reset")
        before = self.profile, self._stiffness_scale, self._friction_scale, self._faults, self.lab
        if world is not None:
            self._set_world(world)
        self.lab = Lab(self.profile, seed)
        try:
            plant = self._plant_of(scene)
        except (ValueError, DeviceFault):
            self.profile, self._stiffness_scale, self._friction_scale, self._faults, self.lab = before
            raise
        self.seed, self._steps = seed, 0
        self._origin_ns = begin_ns if self.lockstep else time.time_ns()
        self._restart(plant, scene)
        self.faults.restart(self._faults, seed, self.now_ns(), 0 if self.lockstep else None)

    def restage(self, scene: Scene | dict, part: int = 0) -> None:
        """As `Simulation.restage`. Raises CommandRefused, and changes nothing, for a scene that cannot be."""
        self._need_life("restage")
        self.plant("world", "restage")
        try:
            scene = scene if isinstance(scene, Scene) else Scene.model_validate(scene)
            plant = self._plant_of(scene)
        except ValueError as error:
            raise CommandRefused("world", "restage", str(error), "Correct the scene") from error
        self._restart(plant, scene)
        self._draw_afresh("part", part)

    def _restart(self, plant: Plant, scene: Scene) -> None:
        """``plant``, made of ``scene``, and every device as it is at first; time has been seen to."""
        self.scene, self._plant, self._owed_ns = scene, plant, 0
        for name, device in self.devices.items():
            if (restart := getattr(device, "restart", None)) is not None:
                # a stream of its own per device: adding one leaves the others' noise as it was
                restart(np.random.default_rng([self.seed, crc32(name.encode())]))
        if self._arm is not None:
            self._arm.place(scene.start)

    def _draw_afresh(self, what: str, number: int) -> None:
        """Noise, walks, losses and the arm's repeatability by ``what`` and ``number``, whatever was drawn before."""
        for name, device in self.devices.items():
            if (begin_trial := getattr(device, "begin_trial", None)) is not None:
                # the arm's name does not count: an arm by another name has the same errors
                own = (f"arm.{what}", number) if device is self._arm else (name, what, number)
                begin_trial(stream(self.seed, *own))
        self.faults.begin_trial(self.seed, what, number)

    def staged(self) -> Scene | None:
        """The scene as it was asked for; None until the first reset. For any thread."""
        return None if self._plant is None else self.scene

    def _plant_of(self, scene: Scene) -> Plant:
        fingers = self.profile.fingers
        limit = fingers.force_limit or inf, fingers.torque_limit or inf
        return Plant(self._actual(scene), self._stiffness_scale, self._timestep, self.profile.membrane, limit)

    def _actual(self, scene: Scene) -> Scene:
        """The scene as it truly is in this lab."""
        start = tuple(a + b for a, b in zip(scene.start, self.lab.arm_bias, strict=True))
        stiffness = tuple(tuple(row) for row in self.lab.stiffness(scene.stiffness).tolist())
        changed = {"start": start, "stiffness": stiffness, "friction": self._true_friction(scene)}
        return scene.model_copy(update=changed)

    def _true_friction(self, scene: Scene) -> dict[str, float]:
        """The coefficients of this lab. A body keeps its own by its name, whichever role it has: an eo that is held.

        What has changed since they were found goes by the roles of the scene.
        """
        held, met = scene.grasped.name, "eo" if scene.extrinsic is None else scene.extrinsic.name
        of_pair = {"go-ground": f"{held}-ground", "go-eo": f"{held}-{met}", "eo-ground": f"{met}-ground"}
        true = self.lab.friction({of_pair.get(pair, pair): mu for pair, mu in scene.friction.items()})
        return {pair: true[of_pair.get(pair, pair)] * self._friction_scale.get(pair, 1.0) for pair in scene.friction}

    def regrasp(self, trial: int) -> None:
        """Take the go into the fingers anew, as between trials, and draw what no calibration removes.

        How the go lies in the fingers, what the handling leaves in their membranes, the arm's errors of repeatability,
        the walk of the force/torque sensors' zeros and the noise of the pictures follow from the seed and ``trial``
        (from 0) alone. No time passes; the go hangs at rest. A profile without such errors leaves everything as it is.
        Raises DeviceFault while there is no scene, CommandRefused where the go would touch something.
        """
        plant = self.plant("world", "regrasp")
        if trial < 0:
            raise CommandRefused("world", "regrasp", f"trial {trial}", "Trials count from 0")
        self._draw_afresh("trial", trial)
        offset, fresh = self.lab.grasp_offset(trial), not plant.membrane.is_linear or min(plant.finger_limit) < inf
        if plant.held and (fresh or offset.any()):
            plant.regrasp(se2.compose(np.array(self.scene.grasp), offset), self.lab.membrane_strain(trial))

    def rearrange(self, scene: Scene | dict) -> None:
        """As `Simulation.rearrange`. Raises CommandRefused, and changes nothing, for a scene that cannot be."""
        before = self.plant("world", "rearrange")
        try:
            scene = scene if isinstance(scene, Scene) else Scene.model_validate(scene)
            believed = tuple(a - b for a, b in zip(before.ee_pose, self.lab.arm_bias, strict=True))
            scene = scene.model_copy(update={"start": believed})
            self._plant = self._plant_of(scene)
        except ValueError as error:
            raise CommandRefused("world", "rearrange", str(error), "Correct the scene, or lift the arm") from error
        self.scene = scene

    def clamp(self, body: str | None) -> None:
        """As `Simulation.clamp`."""
        self.plant("world", "clamp").clamp(body)

    def show_board(self, board: TagBoard | dict | None, X_W_B: ArrayLike) -> None:
        """As `Simulation.show_board`. Raises CommandRefused where there is no camera, or for what cannot be shown."""
        cameras = [show for device in self.devices.values() if (show := getattr(device, "show", None)) is not None]
        if not cameras:
            raise CommandRefused("world", "show a board", "there is no tag camera", "Add one to the station file")
        try:
            shown = board if board is None or isinstance(board, TagBoard) else TagBoard.from_dict(board)
            pose = rigid("its pose X_W_B", X_W_B)
        except (ValueError, TypeError) as error:
            raise CommandRefused("world", "show a board", str(error), "Correct the board or its pose") from error
        for show in cameras:
            show(shown, pose)

    def truth(self) -> TruthReading:
        """The plant's own state at this instant; its sequence number is that of the plant step."""
        plant = self.plant("world", "truth")
        now = self.now_ns()
        return TruthReading(
            Stamp(now, now, self._steps, "world"),
            plant.ee,
            plant.go,
            plant.eo,
            plant.coupling_wrench(self._believed_grasp(plant)),
            plant.contacts(),
        )

    def _believed_grasp(self, plant: Plant) -> Array | None:
        """The scene's grasp centre in W, about which plans and errors count torques; None where it is the true one."""
        if tuple(plant.coupling.grasp) == self.scene.grasp:
            return None
        return se2.compose(plant.go, np.array(self.scene.grasp))[:2]

    def health(self) -> dict[str, Any]:
        """How well the plant was since the reset: `drivers.sim.health.Health.summary`."""
        return self.plant("world", "tell its health").health()

    def counts(self) -> dict[str, int]:
        """Readings per device since the reset."""
        return {
            name: device.count if isinstance(device, Simulated) else getattr(device, "_sequence", 0)
            for name, device in self.devices.items()
            if isinstance(device, Sensor)
        }

    # -- for the devices -----------------------------------------------------------------------------------------

    def plant(self, device: str = "world", asked: str = "use") -> Plant:
        """The plant. Raises DeviceFault, for ``device`` that ``asked``, while there is no scene."""
        if self._plant is None:
            raise DeviceFault(
                device,
                asked,
                "the world has no scene yet",
                "Reset it with one first: `simulation.reset(seed, scene)`",
                recoverable=True,
            )
        return self._plant

    def finger_view(self) -> FingerView:
        """What the fingers feel of the held object at this instant."""
        plant = self.plant("world", "feel the held object")
        outline = np.array(self.scene.grasped.vertices, float)
        X_ee_go = se2.between(plant.ee, plant.go)
        X_ee_gocf = se2.compose(X_ee_go, plant.coupling.grasp)
        return FingerView(outline, X_ee_go, X_ee_gocf, plant.held)

    def visible_tags(self) -> list[tuple[TagMount, Array]]:
        """Every tag with the pose X_W_body (3,) of the body that carries it; the table is at the origin."""
        plant = self.plant("world", "look at the tags")
        tags = [(mount, np.zeros(3)) for mount in self.config.table_tags]
        for body, pose in ((self.scene.grasped, plant.go), (self.scene.extrinsic, plant.eo)):
            if body is not None and pose is not None:
                tags += [(mount, pose) for mount in body.tags]
        if not self.profile.camera.tag_bias.si.any():
            return tags
        return [(self._as_it_sits(mount), pose) for mount, pose in tags]

    def tag_twists(self) -> dict[int, Array]:
        """Velocity (3,) in W, (ẋ, ẏ, θ̇), of the objects, by the ids of their tags."""
        plant = self.plant("world", "look at the tags")
        bodies = {"go": self.scene.grasped, "eo": self.scene.extrinsic}
        return {tag.id: plant.twist(name) for name, body in bodies.items() if body is not None for tag in body.tags}

    def screens(self) -> list[Screen]:
        """What stands in front of the tags: the finger on the viewer's side, where the station has fingers."""
        plant = self.plant("world", "look at the tags")
        fingers = [d for d in self.config.devices.values() if isinstance(d, TactileConfig) and d.finger == "left"]
        if not fingers and not any(device.kind == "gripper" for device in self.config.devices.values()):
            return []
        sensor = fingers[0].sensor if fingers else "soft_bubble"
        return [Screen(plant.ee, FINGER_HALF_SIZE[sensor])]

    def _as_it_sits(self, mount: TagMount) -> TagMount:
        x, y, angle = se2.compose(np.array(mount.pose), self.lab.tag_bias(mount.id)).tolist()
        return mount.model_copy(update={"pose": (x, y, angle)})
