"""Draws the planar scene into a recording: bodies at their poses, contacts, forces, what is believed and how surely.

In a picture y points down, in the plane up: everything lies under a mirror, ``…/plane``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from experiments.view import figures
from experiments.view.figures import Colour
from experiments.view.sheet import At, Sheet
from mechanics import se2
from mechanics.readings import Array, ContactTruth
from mechanics.records import ContactBelief, PlanarState


@dataclass(frozen=True)
class Bodies:
    """The outlines (N, 2) [m] of what may be there, by role (``go``, ``eo``), and the grasp X_go_gocf (3,)."""

    outlines: Mapping[str, Array]
    grasp: Array


class Scene:
    """The planar scene of one scope, under ``root``. ``box`` is (left, bottom, right, top) of all that was drawn."""

    def __init__(self, sheet: Sheet, root: str, bodies: Bodies):
        import rerun as rr

        self._rr, self._sheet = rr, sheet
        self._take(bodies)
        self._drawn: dict[tuple[str, bool, bool], int] = {}
        self.root, self._plane = root, f"{root}/plane"
        self.box: tuple[float, float, float, float] | None = None
        sheet.once(self._plane, lambda: rr.Transform3D(mat3x3=np.diag([1.0, -1.0, 1.0])))
        ground = [[[-1.0, 0.0], [1.0, 0.0]]]
        sheet.once(f"{self._plane}/ground", lambda: rr.LineStrips2D(ground, colors=[figures.GROUND], draw_order=-10))

    def _take(self, bodies: Bodies) -> None:
        self._bodies = bodies
        self._sizes = {role: float(np.hypot(*outline.T).max()) for role, outline in bodies.outlines.items()}

    def redraw(self, bodies: Bodies) -> None:
        """Other bodies stand on the table from now on."""
        self._take(bodies)
        self._drawn.clear()

    def state(self, source: str, at: At, state: PlanarState) -> None:
        """The bodies where ``source`` (one of `figures.SOURCES`) says that they are, and the wrench's force."""
        for body in ("ee", "go", "eo"):
            pose = getattr(state, body)
            if pose is not None:
                self.body(source, body, at, pose)
        if state.go is not None:
            centre = se2.compose(state.go, self._bodies.grasp)[:2]
            self._forces(f"{source}/wrench", at, [centre], [state.wrench[:2]], [figures.SOURCES[source]])

    def body(self, source: str, body: str, at: At, pose: Array) -> None:
        """One body at a pose (3,) in W."""
        if not np.isfinite(pose).all() or (body != "ee" and body not in self._bodies.outlines):
            return
        path = f"{self._plane}/{source}/{body}"
        self._sheet.pose(path, at, pose)
        if self._is_new(path, at):  # not before it has been seen anywhere
            self._sheet.log(f"{path}/outline", at, self._outline(source, body))
            if source in ("truth", "measured") and body != "eo":
                self._sheet.log(f"{path}/frame", at, self._frame(body))
        self._reach(body, pose)

    def contacts(self, source: str, at: At, contacts: Sequence[ContactTruth] | Sequence[Mapping[str, Any]]) -> None:
        """Contacts in W: a dot coloured by what the contact does, and its force."""
        told = [_contact(contact) for contact in contacts]
        colours = [figures.MODES.get(mode, figures.FREE) for _, _, mode in told]
        points = [point for point, _, _ in told]
        self._sheet.put(
            f"{self._plane}/{source}/contacts",
            self._rr.Points2D,
            at,
            len(told),
            positions=points,
            colors=_packed(colours),
            radii=[-4.0] * len(told),  # negative: of the screen
            labels=[mode for _, _, mode in told],
        )
        shown = colours if source == "truth" else [figures.SOURCES[source]] * len(told)
        self._forces(f"{source}/forces", at, points, [force for _, force, _ in told], shown)

    def belief(self, at: At, go: Array, belief: ContactBelief) -> None:
        """Where the go at ``go`` (3,) is believed to be touched: the more likely, the larger."""
        points = se2.transform(go, belief.points) if len(belief.points) else belief.points
        self._sheet.put(
            f"{self._plane}/estimated/touched",
            self._rr.Points2D,
            at,
            len(points),
            positions=points,
            colors=_packed([figures.SOURCES["estimated"]] * len(points)),
            radii=[-2.0 - 4.0 * float(weight) for weight in belief.weights],
            labels=[f"{weight:.0%}" for weight in belief.weights],
        )

    def spread(self, at: At, body: str, place: Array, covariance: Array) -> None:
        """How surely a body's place (2,) in W is known: the ellipse of its covariance (2, 2)."""
        self._sheet.log(
            f"{self._plane}/estimated/{body}_2sigma",
            at,
            self._rr.LineStrips2D([figures.ellipse(place, covariance)], colors=[figures.SOURCES["estimated"]]),
        )

    def _outline(self, source: str, body: str) -> Any:
        vertices = figures.finger() if body == "ee" else figures.closed(self._bodies.outlines[body])
        colour = figures.EXTRINSIC if (source, body) == ("truth", "eo") else figures.SOURCES[source]
        radius = -1.5 if source == "truth" else -0.8
        return self._rr.LineStrips2D([vertices], colors=[colour], radii=[radius])

    def _is_new(self, path: str, at: At) -> bool:
        """Whether nothing was drawn there yet by this moment; a simulated station's time may begin again."""
        line = (path, at.t_ns is None, at.waypoint is None)
        now = at.waypoint if at.t_ns is None else at.t_ns
        first = self._drawn.get(line)
        if now is None or (first is not None and first <= now):
            return False
        self._drawn[line] = now
        return True

    def _frame(self, body: str) -> Any:
        """ee itself, and of the grasped object the object-sensor contact frame."""
        pose = np.zeros(3) if body == "ee" else self._bodies.grasp
        strips = [se2.transform(pose, axis) for axis in figures.axes()]
        return self._rr.LineStrips2D(strips, colors=list(figures.AXES))

    def _forces(
        self, name: str, at: At, points: Sequence[Array], forces: Sequence[Array], colours: Sequence[Colour]
    ) -> None:
        sizes = [float(np.hypot(*force)) for force in forces]
        self._sheet.put(
            f"{self._plane}/{name}",
            self._rr.Arrows2D,
            at,
            len(sizes),
            origins=points,
            vectors=[figures.NEWTON * np.asarray(force) for force in forces],
            colors=_packed(colours),
            labels=[f"{size:.1f} N" for size in sizes],
        )

    def _reach(self, body: str, pose: Array) -> None:
        """Take a body into the box, however it is turned."""
        size = figures.REACH if body == "ee" else self._sizes[body]
        x, y = float(pose[0]), float(pose[1])
        left, bottom, right, top = self.box or (x, y, x, y)
        self.box = min(left, x - size), min(bottom, y - size), max(right, x + size), max(top, y + size)


def _contact(contact: ContactTruth | Mapping[str, Any]) -> tuple[Array, Array, str]:
    if isinstance(contact, ContactTruth):
        return contact.point, contact.force, contact.mode
    return np.asarray(contact["point"]), np.asarray(contact["force"]), str(contact["mode"])


def _packed(colours: Sequence[Colour]) -> NDArray[np.uint32]:
    """Colours as 0xRRGGBBAA, for columns."""
    return np.array([r << 24 | g << 16 | b << 8 | 0xFF for r, g, b in colours], np.uint32)
