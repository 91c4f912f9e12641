"""Contact trajectory problems for tests: the pivoting pentagon, and random ones of every kind.

All geometry here is plain numpy, written without the package: what the tests compare it with.
"""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from scipy.optimize import linprog
from scipy.spatial import ConvexHull

from mechanics.catalogue import load_object, load_sensor
from mechanics.friction import Mode
from planning.problem import (
    Body,
    Form,
    GroundContact,
    Limits,
    LossWeights,
    ObjectContact,
    PlanarArm,
    Problem,
    Touch,
)

SHAPES = ("tall_box", "hbox", "z", "heptagon", "pentagon", "triangle")
#: what each skill with an extrinsic object moves where a test does not say
MOVED = {
    "static_in_contact": "hbox",
    "relative_pivoting": "hbox",
    "relative_sliding": "hbox",
    "extrinsic_pushing": "hbox",
    "extrinsic_pivoting": "tall_box",
}
GRASP = np.array([0.0, 0.045, 0.0])
TOUCHING = (Mode.STICK, Mode.SLIP_POSITIVE, Mode.SLIP_NEGATIVE)

#: every kind of problem: form, whether there is an extrinsic object, touch, mode of the object contact
KINDS = tuple(itertools.product(Form, (True, False), Touch, (*TOUCHING, Mode.FREE)))


def turn(angle: float) -> np.ndarray:
    """Rotation (2, 2)."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s], [s, c]])


def cross(a, b):
    """Moment of b at lever a."""
    return a[0] * b[1] - a[1] * b[0]


def clockwise(n):
    """A vector (2,) turned by −90°."""
    return np.array([n[1], -n[0]])


def shape(name: str, mass: float | None = None) -> Body:
    """A body of the catalogue."""
    model = load_object(name)
    return Body(model.polygon.vertices, model.mass if mass is None else mass, model.polygon.radius_of_gyration)


def soft_bubble() -> np.ndarray:
    """K (3, 3)."""
    return load_sensor("soft_bubble").stiffness


def outward(vertices, i: int) -> np.ndarray:
    """Outward unit normal (2,) of the face from vertex i to the next."""
    edge = vertices[(i + 1) % len(vertices)] - vertices[i]
    return clockwise(edge) / np.hypot(*edge)


def admissible_angles(vertices, i: int, normal) -> tuple[float, float]:
    """Least and largest angle at which the body's corner i touches a face with this outward normal (2,), in W, without
    going into it: both edges of the corner point away from the face."""
    v = vertices
    into, back = v[(i + 1) % len(v)] - v[i], v[i - 1] - v[i]
    first = np.arctan2(into[1], into[0])
    wedge = np.mod(np.arctan2(back[1], back[0]) - first, 2 * np.pi)
    middle = np.arctan2(normal[1], normal[0]) - (first + wedge / 2)
    middle = np.mod(middle + np.pi, 2 * np.pi) - np.pi
    return middle - (np.pi - wedge) / 2, middle + (np.pi - wedge) / 2


def contact_of(contact: ObjectContact, eo, angle: float, travel: float, two_bodies: bool):
    """The go's pose (3,), the contact's point (2,) and unit normal (2,) into the body acted on, all in W."""
    R_E, R_go = turn(eo[2]), turn(eo[2] + angle)
    e = clockwise(contact.normal)
    if contact.touch is Touch.CORNER_ON_FACE:
        point, arm, face = eo[:2] + R_E @ (contact.p_eo + travel * e), contact.p_go, R_E @ contact.normal
        owner_is_eo = True
    else:
        point, arm, face = eo[:2] + R_E @ contact.p_eo, contact.p_go + travel * e, R_go @ contact.normal
        owner_is_eo = False
    return np.append(point - R_go @ arm, eo[2] + angle), point, -face if owner_is_eo == two_bodies else face


def nominal_go(problem: Problem) -> np.ndarray:
    """X_W_go (K, 3) at the nominal values."""
    return np.array(
        [
            contact_of(problem.contacts[0], problem.eo[k], problem.angle[k], problem.travel[k], bool(problem.eo_body))[
                0
            ]
            for k in range(len(problem.eo))
        ]
    )


def free_variables(form: Form, modes, angle: bool = True) -> np.ndarray:
    """(K, 5): the angle unless it is fixed, travel where the first contact slips, what the form uses of v."""
    free = np.ones((len(modes), 5), bool)
    free[:, 0] = angle
    free[:, 1] = [mode.slip_sign != 0 for mode in modes]
    free[:, 4] = form is Form.PAPER
    return free


def pivoting_pentagon(form: Form = Form.CLOSED, steps: int = 40, **changes) -> Problem:
    """The pentagon of the catalogue, turned by 25° clockwise about its bottom-right vertex by the right corner of
    tall_box, 8 mm from the apex on the upper left face, with 3 N. ``changes`` replaces fields."""
    eo_body, go_body, mu_object, mu_ground, force = shape("pentagon"), shape("tall_box"), 0.33, 0.5, 3.0
    v = eo_body.vertices
    theta = -np.radians(np.linspace(0.3, 25.0, steps))
    pivot = v[np.lexsort((-v[:, 0], v[:, 1].round(9)))[0]]
    apex = int(np.argmax(v[:, 1]))
    along = v[(apex + 1) % len(v)] - v[apex]
    point, normal = v[apex] + 0.008 * along / np.hypot(*along), outward(v, apex)
    corner = int(np.lexsort((-go_body.vertices[:, 0], go_body.vertices[:, 1].round(9)))[0])
    wish = []
    for angle in theta:  # the tangential part that balances the weight about the pivot
        n = -turn(angle) @ normal
        lever, weight = turn(angle) @ (point - pivot), np.array([0.0, -9.81 * eo_body.mass])
        moment = force * cross(lever, n) + cross(-turn(angle) @ pivot, weight)
        wish.append([force, -moment / cross(lever, clockwise(n))])
    contact = ObjectContact(
        name="object",
        touch=Touch.CORNER_ON_FACE,
        p_go=go_body.vertices[corner],
        p_eo=point,
        normal=normal,
        modes=(Mode.STICK,) * steps,
        mu=mu_object,
        wish=np.array(wish),
    )
    tilt = np.arctan2(-normal[0], normal[1]) - np.radians(20.0)
    problem = Problem(
        skill="extrinsic_pivoting",
        form=form,
        eo=np.array([[*(-turn(angle) @ pivot), angle] for angle in theta]),
        eo_body=eo_body,
        go_body=go_body,
        grasp=GRASP,
        stiffness=soft_bubble(),
        contacts=(contact,),
        ground=(GroundContact("ground", pivot, (Mode.STICK,) * steps, mu_ground),),
        angle=np.full(steps, tilt),
        travel=np.zeros(steps),
        free=free_variables(form, contact.modes),
        angle_limits=np.tile(admissible_angles(go_body.vertices, corner, normal), (steps, 1)),
    )
    return replace(problem, **changes)


def random_problem(
    rng: np.random.Generator,
    *,
    form: Form | None = None,
    two_bodies: bool | None = None,
    touch: Touch | None = None,
    mode: Mode | None = None,
    steps: int | None = None,
    limits: bool | None = None,
    contacts: int | None = None,
    ground: int | None = None,
) -> Problem:
    """A valid problem whose programs have solutions at and near the nominal values; what is None is drawn.

    ``two_bodies`` chooses P1; ``mode`` is that of the object contact(s) at every step; ``contacts`` is 1 or, for P2, 2
    (the go lies flat); ``ground`` is 1 (the eo stands on a vertex) or 2 (on a face); ``limits`` adds every barrier.
    """
    two_bodies = bool(rng.integers(2)) if two_bodies is None else two_bodies
    form = rng.choice(list(Form)) if form is None else form
    touch = Touch(rng.choice(list(Touch))) if touch is None else touch
    mode = Mode(rng.choice([*TOUCHING, *TOUCHING, Mode.FREE])) if mode is None else mode
    steps = int(rng.integers(2, 7)) if steps is None else steps
    for _ in range(1000):
        made = (
            _two_bodies(rng, form, touch, mode, steps, ground)
            if two_bodies
            else _environment(rng, form, touch, mode, steps, contacts)
        )
        if made is not None:
            break
    else:
        raise RuntimeError("no feasible problem found")
    names = ("cone", "pull", "smooth", "force", "penetration", "slack", "track")
    weights = LossWeights(**{name: float(np.exp(rng.uniform(-3, 1))) for name in names})
    changes = {"force_weight": float(np.exp(rng.uniform(-2, 2))), "slack_weight": float(np.exp(rng.uniform(1, 6)))}
    limits = bool(rng.integers(2)) if limits is None else limits
    return replace(made, weights=weights, limits=_limits(rng, made) if limits else Limits(), **changes)


def random_z(problem: Problem, rng: np.random.Generator, spread: float = 1.0) -> np.ndarray:
    """z (K, 5) near the problem's start, different where it is free: mm, N, and 0.5° of angle at ``spread`` 1."""
    return problem.start + np.where(problem.free, spread * 0.4 * rng.uniform(-1, 1, problem.start.shape), 0.0)


def _angles(rng, limits: np.ndarray) -> np.ndarray:
    """Angles (K,) well inside their limits (K, 2), slowly changing."""
    at = np.linspace(rng.uniform(0.3, 0.7), rng.uniform(0.3, 0.7), len(limits))
    return limits[:, 0] + at * (limits[:, 1] - limits[:, 0])


def _travel(rng, modes, longest: float) -> np.ndarray:
    """Travel (K,) as the modes say: where it grows, the body acted on sees the other move along −t, which is slip−."""
    by = np.array([-mode.slip_sign * rng.uniform(0, 1) for mode in modes])
    by[0] = 0.0
    travel = np.cumsum(by)
    return travel * min(1e-3, longest / max(np.abs(travel).max(), 1e-12))


def _touch(rng, touch: Touch, go: Body, other: Body | None, mode: Mode, steps: int, mu: float):
    """A contact, its angle limits (2,) and travel (K,); ``other`` None is an environment without outline."""
    face_owner, corner_owner = (other, go) if touch is Touch.CORNER_ON_FACE else (go, other)
    if corner_owner is None:
        wedge = np.array([[0.0, 0.0], [0.3, -0.3], [0.3, 0.3]])
        v, corner = rng.uniform(-0.1, 0.1, 2) + wedge @ turn(rng.uniform(-np.pi, np.pi)).T, 0
    else:
        v, corner = corner_owner.vertices, int(rng.integers(len(corner_owner.vertices)))
    if cross(v[corner] - v[corner - 1], v[(corner + 1) % len(v)] - v[corner]) <= 0:
        return None  # a corner that points inward touches no face
    if face_owner is None:
        angle = rng.choice([np.pi / 2, rng.uniform(-np.pi, np.pi)])
        normal, point, room = np.array([np.cos(angle), np.sin(angle)]), rng.uniform(-0.1, 0.1, 2), 0.02
        if angle == np.pi / 2:
            normal, point[1] = np.array([0.0, 1.0]), 0.0
    else:
        w = face_owner.vertices
        i, at = int(rng.integers(len(w))), rng.uniform(0.2, 0.8)
        edge = w[(i + 1) % len(w)] - w[i]
        normal, point, room = outward(w, i), w[i] + at * edge, 0.15 * np.hypot(*edge)
    lo, hi = admissible_angles(v, corner, normal)  # of the corner's body relative to the face's
    limits = np.array([lo, hi] if touch is Touch.CORNER_ON_FACE else [-hi, -lo])
    p_go, p_eo = (v[corner], point) if touch is Touch.CORNER_ON_FACE else (point, v[corner])
    modes = (mode,) * steps
    contact = ObjectContact("object", touch, p_go, p_eo, normal, modes, mu, np.zeros((steps, 2)))
    return contact, limits, _travel(rng, modes, room)


def _wish(rng, mode: Mode, mu: float, steps: int) -> np.ndarray:
    f_n = np.linspace(rng.uniform(1.0, 5.0), rng.uniform(1.0, 5.0), steps)
    ratio = {Mode.STICK: rng.uniform(-0.8, 0.8) * mu}.get(mode, mode.slip_sign * mu)
    return np.stack([f_n, ratio * f_n], axis=1) * (mode is not Mode.FREE)


def _environment(rng, form, touch, mode, steps, contacts) -> Problem | None:
    """P2: one contact, or two where the go lies flat on the ground."""
    go = shape(str(rng.choice(SHAPES)), float(rng.uniform(0.05, 0.3)))
    contacts = int(rng.choice([1, 1, 2])) if contacts is None else contacts
    eo = np.tile(rng.choice([0.0, 1.0]) * rng.uniform([-0.1, -0.1, -0.5], [0.1, 0.1, 0.5]), (steps, 1))
    mu = float(rng.uniform(0.2, 0.8))
    if contacts == 1:
        touched = _touch(rng, touch, go, None, mode, steps, mu)
        if touched is None:
            return None
        contact, limits, travel = touched
        parts, angle_limits = (replace(contact, wish=_wish(rng, mode, mu, steps)),), np.tile(limits, (steps, 1))
        angle = _angles(rng, angle_limits)
    else:
        v = go.vertices
        i = int(rng.integers(len(v)))
        ends, n_go = (v[i], v[(i + 1) % len(v)]), outward(v, i)
        angle = np.full(steps, np.mod(-np.pi / 2 - np.arctan2(n_go[1], n_go[0]) + np.pi, 2 * np.pi) - np.pi)
        at = rng.uniform(-0.1, 0.1)
        modes, n_eo = (mode,) * steps, np.array([0.0, 1.0])
        on_face = [np.array([at + (turn(angle[0]) @ (end - ends[0]))[0], 0.0]) for end in ends]
        wish = _wish(rng, mode, mu, steps) / 2
        parts = tuple(
            ObjectContact(name, touch, end, p, n_eo if touch is Touch.CORNER_ON_FACE else n_go, modes, mu, wish)
            for name, end, p in zip(("left", "right"), ends, on_face, strict=True)
        )
        travel = _travel(rng, modes, 0.02)
        if touch is Touch.FACE_ON_CORNER:  # the environment's corners are inside the go's face
            parts = tuple(
                replace(part, p_go=p_go, p_eo=on_face[0] + turn(angle[0]) @ (p_go - ends[0]))
                for part, p_go in zip(
                    parts, (0.8 * ends[0] + 0.2 * ends[1], 0.2 * ends[0] + 0.8 * ends[1]), strict=True
                )
            )
            travel = travel * min(1.0, 0.15 * np.hypot(*(ends[1] - ends[0])) / max(np.abs(travel).max(), 1e-12))
        angle_limits = angle[:, None] + np.array([-0.2, 0.3])
    return Problem(
        skill="random",
        form=form,
        eo=eo,
        eo_body=None,
        go_body=go,
        grasp=GRASP + rng.uniform(-0.02, 0.02, 3),
        stiffness=soft_bubble(),
        contacts=parts,
        ground=(),
        angle=angle,
        travel=travel,
        free=free_variables(form, parts[0].modes, angle=contacts == 1),
        angle_limits=angle_limits,
    )


def _stance(rng, eo: Body, count: int, modes, steps: int):
    """Poses X_W_eo (K, 3) on a vertex (turning about it) or a face, moving as the modes say, and the points."""
    v = eo.vertices
    x = _travel(rng, modes, 0.02)  # on the ground, too, slip− is a motion along +t, which is +x
    if count == 2:
        hull = ConvexHull(v).vertices
        i = int(rng.integers(len(hull)))
        a, b = v[hull[i]], v[hull[(i + 1) % len(hull)]]
        theta, points = np.full(steps, -np.arctan2(*(b - a)[::-1])), (a, b)
    else:
        start = rng.uniform(-np.pi, np.pi)
        theta = np.linspace(start, start + np.radians(rng.uniform(-8, 8)), steps)
        heights = np.array([(v @ turn(angle).T)[:, 1] for angle in theta])
        lowest = heights.argmin(axis=1)
        if np.ptp(lowest) or np.diff(np.sort(heights, axis=1)[:, :2]).min() < 1e-3:
            return None
        points = (v[lowest[0]],)
    pose = np.array([[*(np.array([x[k], 0.0]) - turn(theta[k]) @ points[0]), theta[k]] for k in range(steps)])
    return pose, points


def _two_bodies(rng, form, touch, mode, steps, ground) -> Problem | None:
    """P1: an eo on a vertex or a face, touched by the go."""
    go = shape(str(rng.choice(SHAPES)), float(rng.uniform(0.05, 0.3)))
    body = shape(str(rng.choice(SHAPES)), float(rng.uniform(0.1, 0.5)))
    mu_object, mu_ground = float(rng.uniform(0.2, 0.8)), float(rng.uniform(0.3, 1.0))
    count = (2 if mode is Mode.FREE else int(rng.integers(1, 3))) if ground is None else ground
    kind = Mode(rng.choice([Mode.STICK, Mode.STICK, *TOUCHING]))
    if mode is Mode.FREE:
        kind = Mode.STICK  # it lies there
    kinds = [kind] * count
    if count == 2 and rng.random() < 0.15:
        kinds[int(rng.integers(2))] = Mode.FREE
    stance = _stance(rng, body, count, (kind,) * steps, steps)
    touched = _touch(rng, touch, go, body, mode, steps, mu_object)
    if stance is None or touched is None:
        return None
    (eo, points), (contact, limits, travel) = stance, touched
    angle_limits = np.tile(limits, (steps, 1))
    angle = _angles(rng, angle_limits)
    wish = np.zeros((steps, 2))
    for k in range(steps):
        _, point, normal = contact_of(contact, eo[k], angle[k], travel[k], True)
        at = [point, *(eo[k, :2] + turn(eo[k, 2]) @ p for p in points)]
        normals = [normal, *[np.array([0.0, 1.0])] * count]
        f = _balance(body.mass, eo[k], at, normals, [mode, *kinds], [mu_object, *[mu_ground] * count])
        if f is None:
            return None
        wish[k] = f[0]
    names = ("ground",) if count == 1 else ("ground left", "ground right")
    return Problem(
        skill="random",
        form=form,
        eo=eo,
        eo_body=body,
        go_body=go,
        grasp=GRASP + rng.uniform(-0.02, 0.02, 3),
        stiffness=soft_bubble(),
        contacts=(replace(contact, wish=wish),),
        ground=tuple(
            GroundContact(name, p, (g,) * steps, mu_ground) for name, p, g in zip(names, points, kinds, strict=True)
        ),
        angle=angle,
        travel=travel,
        free=free_variables(form, contact.modes),
        angle_limits=angle_limits,
    )


def _balance(mass: float, eo, points, normals, modes, mu) -> np.ndarray | None:
    """Forces (C, 2) that balance the eo, deep in cones of four fifths of the friction, and press; None if none do."""
    C = len(points)
    columns = []
    for p, n in zip(points, normals, strict=True):
        columns += [[*axis, cross(p - eo[:2], axis)] for axis in (n, clockwise(n))]
    equal, of = [*np.array(columns).T], [0.0, 9.81 * mass, 0.0]
    upper, most = [], []
    for c, mode in enumerate(modes):
        n, t = np.eye(2 * C)[2 * c : 2 * c + 2]
        if mode is Mode.FREE:
            equal, of = [*equal, n, t], [*of, 0.0, 0.0]
            continue
        rows = [-n]
        if mode is Mode.STICK:
            rows += [t - 0.8 * mu[c] * n, -t - 0.8 * mu[c] * n]
        else:
            equal, of = [*equal, t - mode.slip_sign * mu[c] * n], [*of, 0.0]
        upper += [[*row, 1.0] for row in rows]
        most += [0.0] * len(rows)
    bounds = [(0, 6), (-6, 6)] * C + [(0.1, None)]
    found = linprog(
        [*[0.0] * (2 * C), -1.0],
        A_ub=np.array(upper) if upper else None,
        b_ub=most if upper else None,
        A_eq=np.column_stack([equal, np.zeros(len(equal))]),
        b_eq=of,
        bounds=bounds if upper else [*bounds[:-1], (0.1, 1.0)],
    )
    return found.x[:-1].reshape(C, 2) if found.status == 0 else None


def _limits(rng, problem: Problem) -> Limits:
    """Every barrier, wide enough for what the problem nominally does."""
    go = nominal_go(problem)
    ee = np.array([[*(g[:2] + turn(g[2]) @ problem.grasp[:2]), g[2] + problem.grasp[2]] for g in go])
    room = np.array([0.1, 0.1, 0.8])
    q = np.array([rng.uniform(-1, 1), rng.choice([-1, 1]) * rng.uniform(0.8, 2.0), 0.0])
    middle = ee[len(ee) // 2]
    q[2] = np.mod(middle[2] - q[0] - q[1] + np.pi, 2 * np.pi) - np.pi
    upper, fore, tool, zero = 0.5, 0.4, np.array([0.02, -0.1]), rng.uniform(-0.5, 0.5, 3)
    wrist = middle[:2] - turn(middle[2]) @ tool
    base = wrist - turn(q[0]) @ [upper, 0.0] - turn(q[0] + q[1]) @ [fore, 0.0]
    arm = PlanarArm(base, upper, fore, tool, int(np.sign(q[1])), zero, (zero + q)[:, None] + [[-0.7, 0.7]] * 3)
    return Limits(
        workspace=np.stack([ee.min(axis=0) - room, ee.max(axis=0) + room], axis=1), arm=arm, force=30.0, torque=3.0
    )
