"""The figures of docs/concepts.md, drawn from what the code computes.

``python docs/figures.py docs/images/concepts`` draws them anew.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np

mpl.use("svg")

from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from mechanics import se2
from mechanics.catalogue import load_object, load_sensor
from mechanics.elasticity import Elasticity
from mechanics.friction import in_cone
from planning.plan import Plan
from planning.planner import plan
from planning.skills.base import Extrinsic, Held, Scene
from planning.skills.extrinsic_pivoting import ExtrinsicPivoting, ExtrinsicPivotingParameters

INK, MUTED, STICK, SLIP, WRENCH = "#1b1f24", "#68707a", "#c0261b", "#18793a", "#6639ba"
GO, GO_EDGE, EO, EO_EDGE = "#c3e4e1", "#1b6f6d", "#efe2c4", "#80611a"
STYLE: Any = {
    "font.size": 9,
    "font.family": "sans-serif",
    "svg.fonttype": "none",
    "svg.hashsalt": "extrinsic",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "text.color": INK,
    "axes.labelcolor": INK,
    "xtick.color": MUTED,
    "ytick.color": MUTED,
    "axes.edgecolor": MUTED,
    "figure.constrained_layout.use": True,
}
GRASP = np.array([0.0, 0.045, 0.0])
MM = 1e3


def held() -> Held:
    """The tall box in the Soft Bubble, as the demo has it."""
    box, bubble = load_object("tall_box"), load_sensor("soft_bubble")
    return Held(box.polygon.vertices, box.mass, GRASP, bubble.stiffness, box.friction)


def pivoting() -> Plan:
    """The demo's plan on its nominal trajectory: the pentagon turned about its corner by 25°."""
    pentagon = load_object("pentagon")
    scene = Scene(held(), Extrinsic(pentagon.polygon.vertices, pentagon.mass, pentagon.friction, 0.5))
    return plan(ExtrinsicPivoting.task(ExtrinsicPivotingParameters(steps=20), scene), "tip")


def _outline(axes: Any, vertices: Any, pose: Any, **style: Any) -> None:
    axes.fill(*(se2.transform(pose, vertices) * MM).T, linewidth=1.2, **style)


def _axes_of(axes: Any, pose: Any, name: str, offset: tuple[float, float], colour: str = INK) -> None:
    """A frame: its x and y axes, 14 mm long, and its name."""
    origin = pose[:2] * MM
    for turn in (0.0, np.pi / 2):
        tip = 14 * np.array([np.cos(pose[2] + turn), np.sin(pose[2] + turn)])
        axes.annotate("", origin + tip, origin, arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.1})
    axes.annotate(name, origin + np.array(offset), color=colour, fontsize=9, ha="center", va="center")


def _force(axes: Any, at: Any, force: Any, colour: str, scale: float = 10.0) -> None:
    """An arrow of 10 mm per newton that ends where the force acts."""
    arrow = {"arrowstyle": "-|>", "color": colour, "lw": 1.6}
    axes.annotate("", at * MM, at * MM - np.asarray(force) * scale, arrowprops=arrow)


def frames() -> Figure:
    """W, ee, gocf, go and eo in the demo's plan, with the forces on the pentagon."""
    tip, box, pentagon = pivoting(), load_object("tall_box").polygon, load_object("pentagon").polygon
    step = 13
    assert tip.eo is not None
    figure, axes = plt.subplots(figsize=(5.6, 6.2))
    axes.axhline(0, color=MUTED, lw=1)
    axes.fill_between([-125, 75], -60, 0, color="#eef0f2", lw=0)
    _outline(axes, pentagon.vertices, tip.eo[0], facecolor="none", edgecolor=EO_EDGE, linestyle=":")
    _outline(axes, pentagon.vertices, tip.eo[step], facecolor=EO, edgecolor=EO_EDGE)
    _outline(axes, box.vertices, tip.go[step], facecolor=GO, edgecolor=GO_EDGE)
    gocf = se2.compose(tip.go[step], tip.X_go_gocf)
    for point, normal, force in zip(
        tip.contact_points[step], tip.contact_normals[step], tip.contact_forces[step], strict=True
    ):
        tangent = np.array([normal[1], -normal[0]])
        _force(axes, point, force[0] * normal + force[1] * tangent, STICK)
    _axes_of(axes, np.zeros(3), "W", (18, -6))
    _axes_of(axes, tip.go[step], "go", (-8, -6), GO_EDGE)
    _axes_of(axes, tip.eo[step], "eo", (-8, -5), EO_EDGE)
    _axes_of(axes, gocf, "gocf", (-17, 6), INK)
    _axes_of(axes, tip.ee[step], "ee", (8, -8), WRENCH)
    axes.set(aspect="equal", xlim=(-125, 75), ylim=(-48, 285), xlabel="x [mm]", ylabel="y [mm]")
    return figure


def modes() -> Figure:
    """The Coulomb cone of a contact with its modes, and what each lets the force be."""
    mu = 0.33
    figure, axes = plt.subplots(figsize=(6.4, 3.2))
    f_n = np.array([0.0, 5.0])
    axes.fill_between(f_n, -mu * f_n, mu * f_n, color=STICK, alpha=0.13, lw=0)
    for sign, mode in ((1, "slip+"), (-1, "slip-")):
        axes.plot(f_n, sign * mu * f_n, color=SLIP, lw=2)
        axes.annotate(mode, (4.3, sign * mu * 4.3 + sign * 0.35), color=SLIP, ha="center", va="center")
    axes.plot(0, 0, "o", color=MUTED, ms=6)
    axes.annotate("free", (-0.1, 0.33), color=MUTED, ha="center")
    axes.annotate("stick", (3.1, 0.0), color=STICK, ha="center", va="center")
    draws = np.random.default_rng(4).uniform((0.3, -1.9), (4.9, 1.9), (60, 2))
    inside = in_cone(draws, mu)
    axes.plot(*draws[inside].T, ".", color=STICK, ms=4, alpha=0.7)
    axes.plot(*draws[~inside].T, "x", color=MUTED, ms=3.5, alpha=0.7)
    axes.set(xlabel="normal force $f_n$ [N]", ylabel="tangential force $f_t$ [N]", xlim=(-0.6, 5.2), ylim=(-2.1, 2.1))
    return figure


def elasticity() -> Figure:
    """How far the end-effector moves from where it held the box in air, to press with so much force."""
    figure, (left, right) = plt.subplots(1, 2, figsize=(6.4, 3.0), width_ratios=(1.25, 1))
    newtons = np.linspace(0, 6, 25)
    wrench = np.stack([0 * newtons, -newtons, 0 * newtons], axis=-1)
    for name, label, colour in (("soft_bubble", "Soft Bubble", GO_EDGE), ("gelslim", "GelSlim", EO_EDGE)):
        moved = Elasticity(load_sensor(name).stiffness).displacement(wrench)
        left.plot(newtons, -moved[:, 1] * MM, color=colour, lw=2, label=f"{label}: down")
        left.plot(newtons, moved[:, 0] * MM, color=colour, lw=1.2, ls="--", label=f"{label}: sideways")
    left.set(xlabel="force on the object, down [N]", ylabel="motion of the end-effector [mm]")
    left.legend(frameon=False, fontsize=8)

    box, bubble = load_object("tall_box").polygon, load_sensor("soft_bubble")
    stands = np.array([0.0, -box.vertices[:, 1].min(), 0.0])
    pressed = Elasticity(bubble.stiffness).ee_pose(stands, GRASP, np.array([0.0, -6.0, 0.0]))
    _outline(right, box.vertices, stands, facecolor=GO, edgecolor=GO_EDGE)
    air = se2.compose(stands, GRASP)
    finger = np.array([[-0.014, -0.011], [0.014, -0.011], [0.014, 0.011], [-0.014, 0.011]])
    _outline(right, finger, air, facecolor="none", edgecolor=MUTED, linestyle=":")
    _outline(right, finger, pressed, facecolor="none", edgecolor=WRENCH)
    _axes_of(right, air, "gocf", (-6, 6), MUTED)
    _axes_of(right, pressed, "ee", (-5, -4), WRENCH)
    right.set(aspect="equal", xlim=(-31, 31), ylim=(90, 152), xticks=[], yticks=[])
    right.spines[:].set_visible(False)
    right.set_title("6 N down, to scale", fontsize=9, color=INK)
    return figure


FIGURES = {"frames": frames, "modes": modes, "elasticity": elasticity}


def main(folder: Path) -> None:
    """Draw every figure into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    with mpl.rc_context(STYLE):
        for name, draw in FIGURES.items():
            figure = draw()
            figure.savefig(folder / f"{name}.svg", metadata={"Date": None, "Creator": None})
            plt.close(figure)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
