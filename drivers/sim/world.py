"""The simulated world in one process: the plant, the devices around it, and the time that all of them share."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any
from zlib import crc32

import numpy as np

from drivers.config import StationConfig, WorldConfig
from drivers.errors import DeviceFault
from drivers.interfaces import Device, Sensor
from drivers.scene import Scene, TagMount
from drivers.sim.arm import SimArm
from drivers.sim.device import Simulated
from drivers.sim.finger import FingerView
from drivers.sim.force_torque import SimForceTorque
from drivers.sim.gripper import SimGripper
from drivers.sim.mismatch import load_profile
from drivers.sim.plant import ZERO, Plant
from mechanics import se2
from mechanics.readings import Array, Stamp, TruthReading


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

    def _set_world(self, world: WorldConfig) -> None:
        self.profile = load_profile(world.profile)
        self._stiffness_scale = world.stiffness_scale

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

        What does not fill a step is kept for the next call. Raises DeviceFault when the plant has diverged or there
        is no scene, ValueError for a time that is negative or not finite.
        """
        plant = self.plant("world", "advance")
        if not 0 <= seconds < 1e6:
            raise ValueError(f"world: cannot advance by {seconds} s; expected a finite time that is not negative")
        self._owed_ns += round(seconds * 1e9)
        steps, self._owed_ns = divmod(self._owed_ns, self._timestep_ns)
        dt, arm, sensors, (bx, by, bt) = self._timestep, self._arm, self._sensors, self.profile.arm_bias
        for _ in range(steps):
            if arm is None:
                plant.step(plant.ee_pose, ZERO)
            else:
                arm.advance(dt)
                x, y, theta = arm.pose
                plant.step((x + bx, y + by, theta + bt), arm.twist)
            self._steps += 1
            for sensor in sensors:
                sensor.sample()
        return steps

    # -- Simulation ----------------------------------------------------------------------------------------------

    def reset(self, seed: int, scene: Scene | dict, world: WorldConfig | None = None) -> None:
        """Put ``scene`` into its initial state; ``world`` replaces the profile and the stiffness scale.

        Devices stay as connected, leased and stopped as they were, the arm rests at the scene's start, tares are
        undone, and every stream starts again at 0: its first reading comes one period later. Raises ValueError
        (pydantic's among them) for a scene that cannot be; the world is then as it was.
        """
        scene = scene if isinstance(scene, Scene) else Scene.model_validate(scene)
        before = self.profile, self._stiffness_scale
        if world is not None:
            self._set_world(world)
        try:
            start = tuple(a + b for a, b in zip(scene.start, self.profile.arm_bias, strict=True))
            plant = Plant(scene.model_copy(update={"start": start}), self._stiffness_scale, self._timestep)
        except (ValueError, DeviceFault):
            self.profile, self._stiffness_scale = before
            raise
        self._plant, self.scene, self.seed = plant, scene, seed
        self._steps = self._owed_ns = 0
        self._origin_ns = 0 if self.lockstep else time.time_ns()
        for name, device in self.devices.items():
            if isinstance(device, Simulated):
                # a stream of its own per device: adding one leaves the others' noise as it was
                device.restart(np.random.default_rng([seed, crc32(name.encode())]))
            elif (restart := getattr(device, "restart", None)) is not None:
                restart()
        if self._arm is not None:
            self._arm.place(scene.start)

    def truth(self) -> TruthReading:
        """The plant's own state at this instant; its sequence number is that of the plant step."""
        plant = self.plant("world", "truth")
        now = self.now_ns()
        return TruthReading(
            Stamp(now, now, self._steps, "world"),
            plant.ee,
            plant.go,
            plant.eo,
            plant.coupling_wrench(),
            plant.contacts(),
        )

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
        X_ee_gocf = se2.compose(X_ee_go, np.array(self.scene.grasp))
        return FingerView(outline, X_ee_go, X_ee_gocf, plant.held)

    def visible_tags(self) -> list[tuple[TagMount, Array]]:
        """Every tag with the pose X_W_body (3,) of the body that carries it; the table is at the origin."""
        plant = self.plant("world", "look at the tags")
        tags = [(mount, np.zeros(3)) for mount in self.config.table_tags]
        for body, pose in ((self.scene.grasped, plant.go), (self.scene.extrinsic, plant.eo)):
            if body is not None and body.tag is not None and pose is not None:
                tags.append((body.tag, pose))
        return tags
