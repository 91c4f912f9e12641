"""The curves of a recording: wrenches, poses, raw readings, each with its names, colours and units."""

from __future__ import annotations

import numpy as np

from experiments.view.figures import SIGMAS, SOURCES, Colour
from experiments.view.sheet import At, Sheet
from mechanics.readings import Array, GripperReading
from mechanics.records import PlanarState

TAG: Colour = (46, 200, 90)
MM, DEG = 1e3, float(np.degrees(1.0))


def state(sheet: Sheet, root: str, source: str, at: At, planar: PlanarState) -> None:
    """A state's wrench [N, N·mm] under ``wrench/``, its objects' poses [mm, deg] under ``pose/``, of one source."""
    fx, fy, tau = planar.wrench
    _curves(sheet, f"{root}/wrench/{source}/force", [f"fx {source}", f"fy {source}"], source)
    _curves(sheet, f"{root}/wrench/{source}/torque", [f"τ {source}"], source)
    sheet.scalars(f"{root}/wrench/{source}/force", at, [fx, fy])
    sheet.scalars(f"{root}/wrench/{source}/torque", at, [MM * tau])
    for body in ("go", "eo"):
        pose = getattr(planar, body)
        if pose is not None:
            path = f"{root}/pose/{body}/{source}"
            _curves(sheet, f"{path}/position", [f"x {body} {source}", f"y {body} {source}"], source)
            _curves(sheet, f"{path}/angle", [f"θ {body} {source}"], source)
            sheet.scalars(f"{path}/position", at, MM * pose[:2])
            sheet.scalars(f"{path}/angle", at, [DEG * pose[2]])


def band(sheet: Sheet, root: str, at: At, wrench: Array, covariance: Array, lever: Array) -> None:
    """The band about an estimated wrench (3,). ``covariance`` (3, 3) is about a point ``lever`` (2,) off its own."""
    J = np.eye(3)
    J[2, :2] = -lever[1], lever[0]  # τ about the other point: + lever × f
    reach = SIGMAS * np.sqrt(np.maximum(np.diag(J @ covariance @ J.T), 0.0))
    low, high = wrench - reach, wrench + reach
    force, torque = f"{root}/wrench/estimated_2sigma/force", f"{root}/wrench/estimated_2sigma/torque"
    names = [f"{name} {sign}2σ" for name in ("fx", "fy") for sign in ("−", "+")]
    _curves(sheet, force, names, "estimated", points=False)
    _curves(sheet, torque, ["τ −2σ", "τ +2σ"], "estimated", points=False, paired=False)
    sheet.scalars(force, at, [low[0], high[0], low[1], high[1]])
    sheet.scalars(torque, at, [MM * low[2], MM * high[2]])


def sensor(sheet: Sheet, path: str, at: At, wrench: Array) -> None:
    """A sensor's own six figures [N, N·mm], as it measures them."""
    device = path.rpartition("/")[2]
    _named(sheet, f"{path}/force", [f"{device} f{axis}" for axis in "xyz"])
    _named(sheet, f"{path}/torque", [f"{device} τ{axis}" for axis in "xyz"])
    sheet.scalars(f"{path}/force", at, wrench[:3])
    sheet.scalars(f"{path}/torque", at, MM * wrench[3:])


def pose(sheet: Sheet, path: str, at: At, planar: Array, name: str) -> None:
    """A planar pose [mm, deg]."""
    _named(sheet, f"{path}/position", [f"x {name}", f"y {name}"])
    _named(sheet, f"{path}/angle", [f"θ {name}"])
    sheet.scalars(f"{path}/position", at, MM * planar[:2])
    sheet.scalars(f"{path}/angle", at, [DEG * planar[2]])


def gripper(sheet: Sheet, path: str, at: At, reading: GripperReading) -> None:
    """Opening [mm] and grasp force [N]."""
    _named(sheet, f"{path}/width", ["width"])
    _named(sheet, f"{path}/force", ["grasp force"])
    sheet.scalars(f"{path}/width", at, [MM * reading.width])
    sheet.scalars(f"{path}/force", at, [reading.force])


def _named(sheet: Sheet, path: str, names: list[str]) -> None:
    import rerun as rr

    sheet.once(path, lambda: rr.SeriesLines(names=names))


def _curves(
    sheet: Sheet, path: str, names: list[str], source: str, *, points: bool = True, paired: bool = True
) -> None:
    """Curves in their source's colour, of ``paired`` ones the second half paler; with dots at waypoints."""
    import rerun as rr

    def made() -> tuple[rr.SeriesLines, ...] | tuple[rr.SeriesLines, rr.SeriesPoints]:
        base = SOURCES[source]
        paler = tuple((value + 255) // 2 for value in base)
        split = (len(names) + 1) // 2 if paired else len(names)
        colours = [base] * split + [paler] * (len(names) - split)
        lines = rr.SeriesLines(names=names, colors=colours, widths=[1.5 if points else 0.7] * len(names))
        if not points or source == "truth":
            return (lines,)
        return lines, rr.SeriesPoints(names=names, colors=colours, marker_sizes=[2.5] * len(names))

    sheet.once(path, made)
