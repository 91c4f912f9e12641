"""What a law that re-plans believes of the problem, from what it measures.

Everything that a plan's model leaves over is put down to how the fingers hold the object: X_go_gocf is estimated so
that the measured force and the end-effector's pose explain each other (an input disturbance, offset-free control). The
go stands there where its contacts are: what its mode blocks is known better than any sensor sees it, a contact that
sticks stands where it was seen on average, and only what the mode leaves free follows the measured pose, in part.
So an error of a pose is never answered by a force, and a force is never mistaken for a pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import null_space

from mechanics import se2, wrench
from mechanics.elasticity import Elasticity
from mechanics.friction import Mode, tangent
from mechanics.readings import Array
from mechanics.records import PlanarState
from planning import feasibility
from planning.problem import Problem, Touch
from planning.receding import Seen, as_seen, closing, place_on_face, window
from planning.trajectory import program

#: a place that sticks is the mean of what was seen, the newest weighing this much at least: contacts creep
LEAST = 0.1
#: measured friction is taken for so much less or more than planned at most, and from this normal force [N] on
MU_RANGE, MU_FORCE = (0.5, 2.0), 0.5
#: the grasp sought turns the wrench that it is found from: the change is a hundredth each time
ROUNDS = 4
#: a slipping contact has slipped where it has come this share of the way to its waypoint
SLIPPED = 0.5


@dataclass(frozen=True)
class Gains:
    """How much of an innovation is believed: ``pose`` of what is free to move; ``grasp`` of what explains the force, in
    the long run (the first one in contact is believed, then the mean of the first ones); ``mu`` of friction.

    ``slip`` [m] is how far a sticking contact is seen elsewhere before it has slipped. The grasp stays within ``reach``
    (3,) [m, m, rad] of the one found in air.
    """

    pose: float
    grasp: float
    mu: float
    slip: float
    reach: Array


class _Place:
    """Where something that sticks was seen, on average [m], and whether it was found elsewhere, ``slid``, just now.

    Before the first look it stands where the plan has it, at 0.
    """

    def __init__(self) -> None:
        self.value, self._count, self.slid = 0.0, 0, False

    def see(self, seen: float, slip: float) -> None:
        """Take in where it is seen (NaN: it is not); farther than ``slip`` from where it stood it has slid there."""
        self.slid = abs(seen - self.value) > slip
        if self.slid:
            self.put(seen)
        elif not np.isnan(seen):
            self._count += 1
            self.value += max(1.0 / self._count, LEAST) * (seen - self.value)

    def put(self, at: float) -> None:
        """It stands there from now on."""
        if not np.isnan(at):
            self.value, self._count = at, 1


class Belief:
    """What is believed of ``problem``, whose frame all poses and wrenches here are in."""

    def __init__(self, problem: Problem, gains: Gains):
        self.problem, self._gains = problem, gains
        self.grasp = np.array(problem.grasp)
        self.mu = np.array([contact.mu for contact in (*problem.contacts, *problem.ground)])
        self._planned_mu = self.mu.copy()
        self._in_air, self._looks, self._touches = self.grasp.copy(), 0, 0
        self._along, self._travel = _Place(), _Place()
        self._came: tuple[float, float] | None = None
        #: how far beyond its step what slips has come: along the ground, along the face [m], positive the way it slips
        self.ahead = (0.0, 0.0)

    def seen(self, step: int) -> Seen:
        """What a re-plan from ``step`` on has to know: a place that does not stick is where the plan has it."""
        along = self._along.value if self._ground_mode(step) is Mode.STICK else 0.0
        travel = self._travel.value if self._mode(step) is Mode.STICK else 0.0
        return Seen(self.grasp, self.mu, along, travel)

    def in_air(self, measured: PlanarState) -> None:
        """Learn the grasp from a go that hangs free, as the mean of all looks."""
        if measured.go is None:
            return
        self._looks += 1
        found, force = self.grasp, np.zeros(2)
        for _ in range(ROUNDS):
            torque = self._moment_of(measured.go, found, force, measured.go[:2])
            found = self._grasp_of(measured.ee, measured.go, found, force, torque)
        off = found - self.grasp
        off[2] = se2.wrap(off[2])
        self.grasp = self.grasp + off / self._looks
        self._in_air = self.grasp.copy()

    def in_contact(self, k: int, measured: PlanarState, predicted: float) -> None:
        """Take in a measurement at settled waypoint ``k``, where the command was to bring the go to the relative angle
        ``predicted`` [rad]; all else that is free, to where the problem has it."""
        force = self.contact_force(measured)
        along, turn, travel, angle = self._coordinates(k, measured, predicted)
        self._learn_friction(k, measured, force, along, travel)
        if self._along.slid:
            self._slid_on_ground(force)
        if self._travel.slid:
            self._slid_on_object(k, measured, force)
        eo = self._eo(k, along, turn)
        go, point = closing(self.problem.contacts[0], eo, angle, self.problem.travel[k] + travel)
        found = self.grasp
        for _ in range(ROUNDS):
            if self._flat(k):
                found = self._grasp_of(measured.ee, go, found, force, self._torque(k, measured, found))
            else:
                force = self._force_at(point, go, self._admissible(k, eo, angle, point), measured)
                found = self._grasp_of(measured.ee, go, found, force, self._moment_of(go, found, force, point))
        off = found - self.grasp
        off[2] = se2.wrap(off[2])
        self._touches += 1
        moved = self.grasp + max(1.0 / self._touches, self._gains.grasp) * off - self._in_air
        self.grasp = self._in_air + np.clip(moved, -self._gains.reach, self._gains.reach)
        self.ahead = (
            self._beyond(self._ground_mode(k), along),
            self._beyond(self._mode(k), travel),
        )

    def slipped(self, k: int, measured: PlanarState, contact: str | None) -> bool:
        """Take in that a contact (None: no one knows which) has slipped: where things are, and the friction seen.

        Returns whether forces exist by which the problem can go on from step ``k``.
        """
        problem = self.problem
        of_ground = {ground.name for ground in problem.ground}
        along, travel = self._seen_places(k, measured)
        force = self.contact_force(measured)
        if contact is None or contact in of_ground:
            self._along.put(along)
            self._slid_on_ground(force)
        if contact is None or contact not in of_ground:
            self._travel.put(travel)
            self._slid_on_object(k, measured, force)
        try:
            rest = as_seen(window(problem, k, problem.steps), self.seen(k))
            if problem.eo_body is not None:  # else the ground takes what force its cone admits
                feasibility.check(program(rest, rest.start))
        except (ValueError, feasibility.InfeasiblePlan):
            return False
        return True

    def contact_force(self, measured: PlanarState) -> Array:
        """The force (2,) of the environment on the go, which balances the sensor's and the weight."""
        return -(measured.wrench[:2] + self._weight)

    # -- the contacts' coordinates -----------------------------------------------------------------------------------

    def _coordinates(self, k: int, measured: PlanarState, predicted: float) -> tuple[float, float, float, float]:
        """(along, turn, travel, angle) at step k: what sticks, what is blocked, and what is free, each by its rule."""
        problem, gain = self.problem, self._gains.pose
        along_seen, travel_seen = self._seen_places(k, measured)
        along = self._place(self._along, self._ground_mode(k), along_seen)
        turn = float(problem.eo[k, 2])
        if measured.eo is not None and len(self._touching(k)) == 1:
            turn += gain * float(se2.wrap(measured.eo[2] - turn))
        travel = self._place(self._travel, self._mode(k), travel_seen)
        angle = float(problem.angle[k]) if self._flat(k) else predicted
        if measured.go is not None and not self._flat(k):
            under = problem.eo[k] if measured.eo is None else measured.eo
            angle += gain * float(se2.wrap(measured.go[2] - under[2] - angle))
        return along, turn, travel, angle

    def _seen_places(self, k: int, measured: PlanarState) -> tuple[float, float]:
        """How far along the ground and along the face things are seen from where the problem has step k; NaN: not."""
        problem, along = self.problem, np.nan
        under = problem.eo[k] + np.array([self._along.value, 0.0, 0.0])
        if problem.eo_body is None:
            along = 0.0
        elif measured.eo is not None:
            under = measured.eo
            points = np.array([ground.p_eo for ground in self._touching(k)])
            along = float((se2.transform(under, points) - se2.transform(problem.eo[k], points))[:, 0].mean())
        if measured.go is None:
            return along, np.nan
        return along, place_on_face(problem.contacts[0], under, measured.go) - float(problem.travel[k])

    def _place(self, place: _Place, mode: Mode, seen: float) -> float:
        if mode is not Mode.STICK:
            return 0.0 if np.isnan(seen) else self._gains.pose * seen
        place.see(seen, self._gains.slip)
        return place.value

    def _eo(self, k: int, along: float, turn: float) -> Array:
        """X_W_eo (3,) that stands on the ground where step k has it, but ``along`` it and turned to ``turn``."""
        nominal, touching = self.problem.eo[k], self._touching(k)
        if not touching:
            return nominal
        p_eo = np.asarray(touching[0].p_eo)
        point = se2.transform(nominal, p_eo) + np.array([along, 0.0])
        return np.append(point - se2.rotate(turn, p_eo), turn)

    def _touching(self, k: int) -> list:
        return [ground for ground in self.problem.ground if ground.modes[k] is not Mode.FREE]

    def _flat(self, k: int) -> bool:
        """Whether a face of the go lies on the ground, which fixes its angle and shares the force."""
        return sum(contact.modes[k] is not Mode.FREE for contact in self.problem.contacts) > 1

    def _mode(self, k: int) -> Mode:
        return self.problem.contacts[0].modes[k]

    def _ground_mode(self, k: int) -> Mode:
        touching = self._touching(k)
        return touching[0].modes[k] if touching else Mode.STICK

    @staticmethod
    def _beyond(mode: Mode, offset: float) -> float:
        return max(0.0, -mode.slip_sign * offset)  # what slips− travels along +e, or +x on the ground

    # -- the grasp ---------------------------------------------------------------------------------------------------

    @property
    def _weight(self) -> Array:
        return np.array([0.0, -self.problem.go_body.mass * self.problem.gravity])

    def _grasp_of(self, ee: Array, go: Array, grasp: Array, force: Array, torque: float) -> Array:
        """X_go_gocf (3,) at which fingers that bear the environment's ``force`` (2,) and ``torque`` hold the go there.

        ``torque`` [N·m] is the fingers' own, about ``grasp``, the last guess of what is sought: the wrench turns with
        it, by less each time.
        """
        w = np.append(-(force + self._weight), torque)
        x = Elasticity(self.problem.stiffness).displacement(wrench.rotated(w, -(go[2] + grasp[2])))
        return se2.between(go, se2.compose(ee, se2.inverse(x)))

    def _moment_of(self, go: Array, grasp: Array, force: Array, point: Array) -> float:
        """The fingers' torque [N·m] about ``grasp`` that balances weight and ``force`` (2,) at ``point`` (2,)."""
        centre = se2.transform(go, grasp[:2])
        return -_moment(go[:2] - centre, self._weight) - _moment(point - centre, force)

    def _admissible(self, k: int, eo: Array, angle: float, point: Array) -> tuple[Array, Array]:
        """The forces on the go that modes and balance of the other body admit at step k: f0 (2,) and what may be added
        to it, N (2, n).

        Rows on the force f on the body acted on: it slips along its edge; the extrinsic object's moments about the one
        point on which it stands balance; on ground that slips the sum of its contacts is on the cone's edge.
        """
        problem, contact = self.problem, self.problem.contacts[0]
        on_eo = problem.eo_body is not None
        rows, values = [], []
        sign = contact.modes[k].slip_sign
        if sign:
            theta = eo[2] + (angle if contact.touch is Touch.FACE_ON_CORNER else 0.0)
            n = se2.rotate(theta, contact.normal)
            n = -n if (contact.touch is Touch.CORNER_ON_FACE) == on_eo else n  # into the body acted on
            rows.append(tangent(n) - sign * self.mu[0] * n)
            values.append(0.0)
        touching = self._touching(k)
        if problem.eo_body is not None and touching:
            weight = np.array([0.0, -problem.eo_body.mass * problem.gravity])
            if len(touching) == 1:
                pivot = se2.transform(eo, np.asarray(touching[0].p_eo))
                arm = point - pivot
                rows.append(np.array([-arm[1], arm[0]]))
                values.append(-_moment(eo[:2] - pivot, weight))
            if ground := touching[0].modes[k].slip_sign:
                slope = ground * self.mu[-1]  # −(f + weight) is the ground's: n is +y, t is +x
                rows.append(np.array([1.0, -slope]))
                values.append(slope * weight[1])
        side = -1.0 if on_eo else 1.0
        if not rows:
            return np.zeros(2), np.eye(2)
        B = np.array(rows)
        return side * np.linalg.lstsq(B, np.array(values), rcond=None)[0], null_space(B, rcond=1e-9)

    def _force_at(self, point: Array, go: Array, admissible: tuple[Array, Array], measured: PlanarState) -> Array:
        """The ``admissible`` force (2,) at ``point`` (2,) on the go that explains the measured wrench best.

        Least squares in (f_x, f_y, τ/ρ), by which wrenches are judged: with a lever longer than ρ the torque tells more
        of the force than the force itself does. What no admissible force explains must not be asked of one: the law
        would trade it for an error of pose for good. The torque is about the planned grasp centre on the go, as it is
        told; where the fingers hold the go is another point.
        """
        scale = np.array([1.0, 1.0, 1.0 / self.problem.go_body.rho])
        centre = se2.transform(go, self.problem.grasp[:2])
        to_point = point - centre
        A = scale[:, None] * np.array([[1.0, 0.0], [0.0, 1.0], [-to_point[1], to_point[0]]])
        b = -scale * (measured.wrench + np.append(self._weight, _moment(go[:2] - centre, self._weight)))
        f0, free = admissible
        return f0 if free.shape[1] == 0 else f0 + free @ np.linalg.lstsq(A @ free, b - A @ f0, rcond=None)[0]

    def _torque(self, k: int, measured: PlanarState, grasp: Array) -> float:
        """The fingers' torque [N·m] about ``grasp``, where the force has two points: the plan's, and by how much the
        measured one differs from it."""
        problem = self.problem
        placed, _ = closing(problem.contacts[0], problem.eo[k], problem.angle[k], problem.travel[k])
        total = []
        for held in (problem.grasp, grasp):
            centre = se2.transform(placed, held[:2])
            moment = -_moment(placed[:2] - centre, self._weight)
            for contact in problem.contacts:
                n = np.asarray(contact.normal)
                f = contact.wish[k, 0] * n + contact.wish[k, 1] * tangent(n)
                moment -= _moment(se2.transform(placed, contact.p_go) - centre, f)
            total.append(moment)
        planned, here = total
        return here + float(measured.wrench[2]) - planned

    # -- friction ----------------------------------------------------------------------------------------------------

    def _learn_friction(self, k: int, measured: PlanarState, force: Array, along: float, travel: float) -> None:
        """Where a contact has slipped the way it is to, the ratio at which it came to rest is its friction."""
        n, came = len(self.problem.contacts), self._came
        here = (float(self.problem.eo[k, 0]) + along, float(self.problem.travel[k]) + travel)
        self._came = here
        if came is None or k == 0:
            return
        asked = (float(self.problem.eo[k, 0] - self.problem.eo[k - 1, 0]), float(np.diff(self.problem.travel)[k - 1]))
        if self._mode(k).slip_sign and (here[1] - came[1]) * np.sign(asked[1]) > SLIPPED * abs(asked[1]):
            f = self._on_object(k, measured, force)
            self._believe_mu(0, n, self._ratio(f, self._mode(k).slip_sign), self._gains.mu)
        if self._ground_mode(k).slip_sign and (here[0] - came[0]) * np.sign(asked[0]) > SLIPPED * abs(asked[0]):
            f = self._on_ground(force)
            self._believe_mu(n, len(self.mu), self._ratio(f, self._ground_mode(k).slip_sign), self._gains.mu)

    def _slid_on_object(self, k: int, measured: PlanarState, force: Array) -> None:
        """What stuck to the face has slipped: the ratio at which it stopped is its friction."""
        self._believe_mu(0, len(self.problem.contacts), self._ratio(self._on_object(k, measured, force)))

    def _slid_on_ground(self, force: Array) -> None:
        """And what stuck to the ground."""
        self._believe_mu(len(self.problem.contacts), len(self.mu), self._ratio(self._on_ground(force)))

    def _on_object(self, k: int, measured: PlanarState, force: Array) -> Array:
        """(f_n, f_t) of the go's contact, on the body acted on, of the environment's ``force`` (2,) on the go."""
        problem, contact = self.problem, self.problem.contacts[0]
        theta = problem.eo[k, 2] if measured.eo is None else measured.eo[2]
        on_eo = problem.eo_body is not None
        if contact.touch is Touch.FACE_ON_CORNER:
            theta = theta + problem.angle[k] if measured.go is None else measured.go[2]
            n = se2.rotate(theta, contact.normal if on_eo else -np.asarray(contact.normal))
        else:
            n = se2.rotate(theta, -np.asarray(contact.normal) if on_eo else contact.normal)
        f = -force if on_eo else force
        return np.array([n @ f, tangent(n) @ f])

    def _on_ground(self, force: Array) -> Array:
        """(f_n, f_t) of the ground on the extrinsic object, all contacts together."""
        body = self.problem.eo_body
        weight = 0.0 if body is None else body.mass * self.problem.gravity
        f = force + np.array([0.0, weight])
        return np.array([f[1], f[0]])

    @staticmethod
    def _ratio(force: Array, sign: int = 0) -> float:
        """f_t/f_n the way it slips, or its size; NaN where too little force tells nothing."""
        if force[0] < MU_FORCE:
            return np.nan
        return float(force[1] / force[0]) * sign if sign else float(abs(force[1]) / force[0])

    def _believe_mu(self, first: int, end: int, ratio: float, gain: float = 1.0) -> None:
        if np.isnan(ratio):
            return
        lo, hi = MU_RANGE
        seen = np.clip(ratio, lo * self._planned_mu[first:end], hi * self._planned_mu[first:end])
        self.mu[first:end] += gain * (seen - self.mu[first:end])


def _moment(arm: Array, force: Array) -> float:
    return float(arm[0] * force[1] - arm[1] * force[0])
