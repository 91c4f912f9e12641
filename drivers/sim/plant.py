"""The simulated world's physics: MuJoCo bodies and contacts, and the compliant fingers that hold the grasped object."""

from __future__ import annotations

from collections.abc import Sequence
from math import ceil, cos, hypot, inf, sin
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from drivers.errors import CommandRefused, SimulationDiverged
from drivers.scene import Scene
from drivers.sim.coupling import Coupling, Grip
from drivers.sim.health import LOOK, Health, Touch
from drivers.sim.membrane import Membrane
from drivers.sim.model import Glide, build, mujoco, polar_inertia
from drivers.sim.preflight import refuse_impossible
from mechanics.polygon import Polygon
from mechanics.readings import Array, ContactTruth

#: a contact that moves along its face faster than this [m/s] slips; a sticking one creeps at some nm/s
SLIP_SPEED = 1e-4
#: contact points of one pair of bodies closer than this [m] in the task plane are one contact (of two depths)
SAME_POINT = 1e-4
#: beyond these the state is nonsense: metres or radians, and their rates
FARTHEST, FASTEST = 20.0, 200.0
#: inertia of a degree of freedom that is clamped [kg, kg·m²]: nothing moves it within a step
IMMOVABLE = 1e4
#: the largest product of the go's fastest natural frequency and the step that the explicit coupling may see
RESOLVED = 0.45

Pose = tuple[float, float, float]
ZERO: Pose = (0.0, 0.0, 0.0)


class Plant:
    """A go held by compliant fingers of a kinematic end-effector, an eo where there is one, and the ground y = 0.

    Poses are (x, y, θ) in W, wrenches (fx, fy, τ) in axes of W. One call of `step` is one plant step; the order of
    calls alone decides the state, to the last bit. Forces are those of the newest step, which began ``timestep``
    before the present poses.
    """

    def __init__(
        self,
        scene: Scene,
        stiffness_scale: float = 1.0,
        timestep: float = 0.001,
        membrane: Membrane | None = None,
        finger_limit: tuple[float, float] = (inf, inf),
    ):
        """Compile the scene; `reset` comes next and is called here once.

        ``finger_limit`` is the force [N] and the torque [N·m] beyond which the go slips between the fingers.
        Raises ValueError for a scene that cannot be: no friction for a pair, a stiffness that is not positive
        definite or lets the go spin out, bodies that overlap each other or the ground.
        """
        self.scene, self.timestep = scene, timestep
        self.membrane, self.finger_limit = membrane or Membrane(), finger_limit
        self._inertia = polar_inertia(scene.grasped)
        self._stiffness = np.array(scene.stiffness) * stiffness_scale
        coupling = self._coupling_at(scene.grasp)
        refuse_impossible(scene, coupling)
        self._substeps = max(1, ceil(coupling.fastest * timestep / RESOLVED))
        self._substep = timestep / self._substeps
        self._steps_per_look = max(1, round(LOOK / timestep))
        self.model = build(scene, self._substep)
        self.data = mujoco.MjData(self.model)
        self._glide = Glide(self.model, self.data)
        self._inertias = self.model.dof_M0.copy()
        self._has_eo = scene.extrinsic is not None
        self._owner = [self._body_of(i) for i in range(self.model.ngeom)]
        d = self.data
        self._qpos, self._qvel, self._applied, self._reaction = d.qpos, d.qvel, d.qfrc_applied, d.qfrc_constraint
        self.reset()

    def _coupling_at(self, grasp: ArrayLike) -> Coupling:
        mass, inertia = self.scene.grasped.mass, self._inertia
        return Coupling(self._stiffness, grasp, mass, inertia, self.membrane, self.finger_limit)

    def _body_of(self, geom: int) -> str:
        return self.model.geom(geom).name.rstrip("0123456789")

    # -- time ----------------------------------------------------------------------------------------------------

    def reset(self) -> None:
        """Back to the start: ee at rest at ``scene.start``, the go hanging from it at rest in free air."""
        mujoco.mj_resetData(self.model, self.data)
        self._glide.look()
        self.coupling = self._coupling_at(self.scene.grasp)
        self._slipped = self._turned = 0.0
        self.held = True
        self.clamp(None)
        self.steps = 0
        self._fault: SimulationDiverged | None = None
        #: how often the number of contact points has changed: a contact that flickers at rest is a sick one
        self.contact_changes = 0
        self._ee: Pose = self.scene.start
        self._ee_twist: Pose = ZERO
        self._qpos[:3] = self.coupling.sagged(self._ee, self.scene.gravity)
        if self._has_eo:
            self._qpos[3:6] = self.scene.extrinsic_pose
        self._observe()
        self._apply()
        mujoco.mj_forward(self.model, self.data)
        self._state_of_forces = self._state
        self._contact_points = self.data.ncon
        self._refuse_overlap()
        self._health = Health(self)

    def step(self, X_W_ee: Pose, V_W_ee: Pose) -> None:
        """Advance by one step, at whose end the ee is at ``X_W_ee`` with the twist ``V_W_ee``; all floats in W.

        Raises SimulationDiverged when the state has diverged, and again until `reset`.
        """
        if self._fault is not None:
            raise self._fault
        if self._substeps == 1:
            self._step(X_W_ee, V_W_ee)
        else:
            start = self._ee
            for i in range(1, self._substeps):
                s = i / self._substeps
                x, y, theta = (a + s * (b - a) for a, b in zip(start, X_W_ee, strict=True))
                self._step((x, y, theta), V_W_ee)
            self._step(X_W_ee, V_W_ee)
        self.steps += 1
        if self.steps % self._steps_per_look == 0:
            self._health.look()

    def _step(self, ee: Pose, ee_twist: Pose) -> None:
        self._apply()
        self._state_of_forces = self._state
        mujoco.mj_step(self.model, self.data)
        self._glide.look()
        if self._clamped is not None:
            clamped, at = self._clamped
            self._qpos[clamped], self._qvel[clamped] = at, 0.0
        self._ee, self._ee_twist = ee, ee_twist
        self._observe(self._substep)
        if self.data.ncon != self._contact_points:
            self._contact_points = self.data.ncon
            self.contact_changes += 1

    def _observe(self, dt: float = 0.0) -> None:
        """Take the new state over, which is ``dt`` [s] after the last, and find the grip that acts in it."""
        q, v = self._qpos.tolist(), self._qvel.tolist()
        # sums, which a NaN poisons, and compared so that a NaN fails
        if not (sum(map(abs, q)) < FARTHEST and sum(map(abs, v)) < FASTEST):
            self._diverged(f"the bodies are at {np.round(q, 3).tolist()}")
        self._state = q
        if self.held:
            self._grip = self.coupling.grip(tuple(q[:3]), tuple(v[:3]), self._ee, self._ee_twist, dt)
        else:
            self._grip = Grip(0.0, 0.0, 0.0, *self.coupling.grasp_pose(q[:3])[:2])

    def _apply(self) -> None:
        grip, q = self._grip, self._state
        fx, fy, tau = grip.fx, grip.fy, grip.torque_about(q[0], q[1])
        if not abs(fx) + abs(fy) + abs(tau) < 1e6:
            self._diverged(f"the fingers push with ({fx:.3g}, {fy:.3g}) N, {tau:.3g} N·m")
        applied = self._applied
        applied[0], applied[1], applied[2] = fx, fy, tau

    def _diverged(self, what: str) -> None:
        self._fault = SimulationDiverged(
            "world",
            f"step {self.steps} at {self.steps * self.timestep:.3f} s",
            f"the simulated state has diverged: {what}",
            "Reset the world; the commanded motion was too fast or pressed too deep",
            recoverable=True,
        )
        raise self._fault

    def _refuse_overlap(self) -> None:
        for i in range(self.data.ncon):
            contact = self.data.contact[i]
            pair = sorted(self._owner[g] for g in contact.geom)
            if "go" in pair or contact.dist < -1e-4:
                raise ValueError(
                    f"scene: {pair[0]} and {pair[1]} overlap by {-contact.dist * 1e3:.3g} mm at the start; "
                    f"raise scene.start or move scene.extrinsic_pose"
                )

    # -- the fingers ---------------------------------------------------------------------------------------------

    def release(self) -> None:
        """Open the fingers: the go falls."""
        self.held = False
        self._observe()

    def grasp(self) -> bool:
        """Close the fingers on the go wherever it now is; tells whether it was between them.

        The new grasp has zero wrench at the present poses.
        """
        if not self.held:
            x, y, angle = self._state[:3]
            dx, dy = self._ee[0] - x, self._ee[1] - y
            c, s = cos(angle), sin(angle)
            grasp = np.array([c * dx + s * dy, c * dy - s * dx, self._ee[2] - angle])
            inside = Polygon(np.asarray(self.scene.grasped.vertices)).signed_distance(grasp[:2]) < 0
            if inside:
                self._retire(self.coupling)
                self.coupling = self._coupling_at(grasp)
                self.held = True
                self._observe()
        return self.held

    def regrasp(self, grasp: ArrayLike, strain: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Put the go between the fingers anew with gocf at ``grasp`` (3,) on it: it hangs at rest, its fingers too.

        ``strain`` is what the handling leaves in the membrane, see `MembraneSpring.strain`. No time passes. Raises
        CommandRefused, and changes nothing, where the go would then touch something.
        """
        before, q, v = self.coupling, self._qpos.copy(), self._qvel.copy()
        self.coupling = self._coupling_at(grasp)
        self.coupling.strain(np.asarray(strain, float))
        self._qpos[:3] = self.coupling.sagged(self._ee, self.scene.gravity)
        self._qvel[:3] = 0.0
        mujoco.mj_forward(self.model, self.data)
        touched = [pair for pair in self._touching() if "go" in pair]
        if touched:
            self.coupling, self._qpos[:], self._qvel[:] = before, q, v
            mujoco.mj_forward(self.model, self.data)
            raise CommandRefused(
                "world", "regrasp", f"{touched[0][0]} and {touched[0][1]} would overlap", "Lift the arm first"
            )
        self._retire(before)
        self.held, self._ee_twist = True, ZERO
        self._observe()
        self._state_of_forces = self._state

    def _retire(self, coupling: Coupling) -> None:
        self._slipped += coupling.slipped
        self._turned += coupling.turned

    def clamp(self, body: str | None) -> None:
        """Fix ``body`` (``go`` or ``eo``) to the environment where it is, and whatever was fixed no more.

        Raises CommandRefused, and changes nothing, for a body that is not here.
        """
        if body is not None and not (body == "go" or (body == "eo" and self._has_eo)):
            raise CommandRefused("world", "clamp", f"there is no body '{body}'", "Clamp go, or eo where there is one")
        self.model.dof_M0[:] = self._inertias
        self._clamped: tuple[slice, Array] | None = None
        if body is not None:
            first = 0 if body == "go" else 3
            dofs = slice(first, first + 3)
            # the engine takes the inertia of bodies as simple as these from here, and leaves their armature out
            self.model.dof_M0[dofs] = IMMOVABLE
            self._qvel[dofs] = 0.0
            self._clamped = dofs, self._qpos[dofs].copy()

    def _touching(self) -> list[list[str]]:
        """The pairs of bodies that touch or overlap, sorted by name."""
        contacts = (self.data.contact[i] for i in range(self.data.ncon))
        return [sorted(self._owner[g] for g in contact.geom) for contact in contacts]

    # -- what the plant knows ------------------------------------------------------------------------------------

    @property
    def ee_pose(self) -> Pose:
        """X_W_ee in floats."""
        return self._ee

    @property
    def ee(self) -> Array:
        """X_W_ee (3,)."""
        return np.array(self._ee)

    @property
    def go(self) -> Array:
        """X_W_go (3,)."""
        return np.array(self._state[:3])

    @property
    def eo(self) -> Array | None:
        """X_W_eo (3,), or None where there is no extrinsic object."""
        return np.array(self._state[3:6]) if self._has_eo else None

    @property
    def grip(self) -> Grip:
        """The wrench of the fingers on the go at the present state, in scalars."""
        return self._grip

    def coupling_wrench(self, p_W: ArrayLike | None = None) -> Array:
        """Wrench (3,) of the fingers on the go, axes of W, about ``p_W`` (2,) in W; by default the grasp centre."""
        g = self._grip
        if p_W is None:
            return np.array([g.fx, g.fy, g.tau])
        x, y = np.asarray(p_W, float).tolist()
        return np.array([g.fx, g.fy, g.torque_about(x, y)])

    def table_load(self, x: float = 0.0, y: float = 0.0) -> tuple[float, float, float]:
        """Wrench (fx, fy, τ) of all bodies on the ground about the point (x, y) in W, axes of W, in scalars."""
        # contact forces between the bodies cancel in the sum, so what is left of all constraints is the ground's
        r, q = self._reaction.tolist(), self._state_of_forces
        fx, fy = r[0], r[1]
        tau = r[2] + (q[0] - x) * fy - (q[1] - y) * fx
        if self._has_eo:
            gx, gy = r[3], r[4]
            tau += r[5] + (q[3] - x) * gy - (q[4] - y) * gx
            fx, fy = fx + gx, fy + gy
        if self._clamped is not None:
            cx, cy, ct = self._clamp_load(x, y)
            fx, fy, tau = fx - cx, fy - cy, tau - ct
        return -fx, -fy, -tau

    def _clamp_load(self, x: float, y: float) -> tuple[float, float, float]:
        """What the clamped body hands on to the table top that it is fixed to, about (x, y) in W, axes of W."""
        assert self._clamped is not None
        dofs, q = self._clamped[0], self._state_of_forces
        fx, fy, tau = self._reaction[dofs].tolist()
        first = dofs.start
        if first == 0:
            gx, gy, gt = self._applied[:3].tolist()
            fx, fy, tau = fx + gx, fy + gy, tau + gt
        body = self.scene.grasped if first == 0 else self.scene.extrinsic
        assert body is not None
        fy -= body.mass * self.scene.gravity
        return fx, fy, tau + (q[first] - x) * fy - (q[first + 1] - y) * fx

    def ground_wrench(self, p_W: ArrayLike = (0.0, 0.0)) -> Array:
        """Total wrench (3,) of the go and the eo on the table about ``p_W`` (2,) in W, axes of W."""
        x, y = np.asarray(p_W, float).tolist()
        return np.array(self.table_load(x, y))

    def contacts(self) -> tuple[ContactTruth, ...]:
        """The contacts of the newest step, one per place: on the go or eo by the ground, on the eo by the go.

        The normal points into the body acted on, t is the normal turned by −90°. ``slip+``: that body's contact point
        sees the other move along +t relative to it, so friction pulls it along +t with f_t = +µ f_n; ``slip-`` the
        other way; ``stick`` below `SLIP_SPEED`.
        """
        if not self.data.ncon:
            return ()
        contacts, forces = self.data.contact, self.data.efc_force.tolist()
        merged: list[list] = []
        # floats throughout: arrays of two or three cost ten times as much, fifty times a second
        for address, (first, second), (x, _, y), frame in zip(
            contacts.efc_address.tolist(),
            contacts.geom.tolist(),
            contacts.pos.tolist(),
            contacts.frame.tolist(),
            strict=True,
        ):
            if address < 0:
                continue
            by, on = self._owner[first], self._owner[second]
            # the normal points from the first geom into the second, on which the force acts
            f, g, h = forces[address : address + 3]
            fx = f * frame[0] + g * frame[3] + h * frame[6]
            fy = f * frame[2] + g * frame[5] + h * frame[8]
            size = hypot(frame[0], frame[2])
            nx, ny = frame[0] / size, frame[2] / size
            for other in merged:
                near = max(abs(other[2] - x), abs(other[3] - y)) < SAME_POINT
                if other[:2] == [on, by] and near and other[4] * nx + other[5] * ny > 0.99:
                    other[6] += fx
                    other[7] += fy
                    break
            else:
                merged.append([on, by, x, y, nx, ny, fx, fy])
        return tuple(
            ContactTruth(
                on, by, np.array([x, y]), np.array([nx, ny]), np.array([fx, fy]), self._mode(on, by, x, y, nx, ny)
            )
            for on, by, x, y, nx, ny, fx, fy in sorted(merged, key=lambda one: one[:4])
        )

    # -- how well the plant is -------------------------------------------------------------------------------------

    def health(self) -> dict[str, Any]:
        """`Health.summary` since the reset."""
        return self._health.summary()

    @property
    def finger_slip(self) -> float:
        """How far the go has slipped between the fingers since the reset: length of the path [m]."""
        return self._slipped + self.coupling.slipped

    @property
    def finger_turn(self) -> float:
        """How far it has turned between them, forth and back [rad]."""
        return self._turned + self.coupling.turned

    def deepest(self) -> float:
        """Penetration [m] of the deepest contact, 0 where there is none."""
        return max(0.0, -float(self.data.contact.dist.min())) if self.data.ncon else 0.0

    def touches(self) -> list[Touch]:
        """The contact points that carry load, as `Health` looks at them."""
        if not self.data.ncon:
            return []
        contacts, forces = self.data.contact, self.data.efc_force
        out = []
        for address, (by, on), (x, _, y), frame, friction in zip(
            contacts.efc_address.tolist(),
            contacts.geom.tolist(),
            contacts.pos.tolist(),
            contacts.frame.tolist(),
            contacts.friction.tolist(),
            strict=True,
        ):
            if address < 0:
                continue
            normal, first, second = forces[address : address + 3].tolist()
            if normal > 0:
                share = hypot(first, second) / (friction[0] * normal)
                out.append(Touch(self._owner[on], self._owner[by], x, y, frame[2], -frame[0], share))
        return out

    def place(self, body: str) -> Pose:
        """Pose in W of ``go``, ``eo`` or ``ground``."""
        if body == "ground":
            return ZERO
        first = 0 if body == "go" else 3
        x, y, angle = self._state[first : first + 3]
        return x, y, angle

    def twist(self, body: str) -> Array:
        """Velocity (3,) in W, (ẋ, ẏ, θ̇), of ``go``, ``eo`` or ``ground``."""
        first = {"go": 0, "eo": 3}.get(body)
        return np.zeros(3) if first is None else np.array(self._qvel[first : first + 3])

    def _mode(self, on: str, by: str, x: float, y: float, nx: float, ny: float) -> str:
        (ux, uy), (vx, vy) = self._velocity(on, (x, y)), self._velocity(by, (x, y))
        along = (vx - ux) * ny - (vy - uy) * nx
        if abs(along) < SLIP_SPEED:
            return "stick"
        return "slip+" if along > 0 else "slip-"

    def _velocity(self, body: str, point: Sequence[float] | Array) -> tuple[float, float]:
        """Velocity in W of the point of ``body`` that is at ``point`` (2,) in W."""
        if body == "ground":
            return 0.0, 0.0
        first = 0 if body == "go" else 3
        vx, vy, spin = self._qvel[first : first + 3].tolist()
        x, y = self._state[first : first + 2]
        return vx - spin * (point[1] - y), vy + spin * (point[0] - x)
