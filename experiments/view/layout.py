"""The layout that a recording opens with: a tab for each trial, one for the station, one for what was said."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from experiments.view.scene import Scene
from experiments.view.sheet import TIME
from experiments.view.show import STATION, Scope, Show

if TYPE_CHECKING:
    import rerun.blueprint as rrb

TABS = 12
"""Trials that get a tab; the others are in the tree of streams."""

_MARGIN = 0.03  # about the scene [m]


def layout(show: Show, *, live: bool = False, images: Sequence[str] = ()) -> rrb.Blueprint:
    """A blueprint for what ``show`` was given; ``live`` begins with the station, whose ``images`` will come."""
    import rerun.blueprint as rrb

    tabs: list[Any] = [_trial(rrb, scope) for scope in show.trials[:TABS]]
    station = show.scopes[STATION]
    pictures = list(dict.fromkeys([*images, *station.images]))
    tabs.insert(0 if live else len(tabs), _station(rrb, station, sorted(show.sensors), sorted(show.arms), pictures))
    tabs.append(_text(rrb))
    return rrb.Blueprint(
        rrb.Tabs(*tabs, active_tab=0),
        rrb.TimePanel(timeline=TIME, state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
        auto_views=False,
        auto_layout=False,
    )


def _trial(rrb: Any, scope: Scope) -> Any:
    root = scope.path
    curves = rrb.Tabs(
        _wrench(rrb, root),
        rrb.Vertical(
            *(rrb.TimeSeriesView(origin=f"{root}/pose", contents=_of(root, "pose", *c), name=n) for n, c in _POSES),
            name="poses",
        ),
        active_tab=0,
    )
    right = [curves, *([_images(rrb, root, scope.images)] if scope.images else [])]
    left = rrb.Vertical(_scene(rrb, root, scope.scene), rrb.TextLogView(origin="log", name="log"), row_shares=[3, 1])
    return rrb.Horizontal(left, rrb.Vertical(*right, row_shares=[3, 2][: len(right)]), name=scope.name)


_POSES = (
    ("place of both objects [mm]", ("go/*/position", "eo/*/position")),
    ("angle of both objects [deg]", ("go/*/angle", "eo/*/angle")),
)


def _of(root: str, part: str, *patterns: str) -> list[str]:
    """The paths of a part by patterns with one ``*``, which stands for every source."""
    sources = ("planned", "measured", "estimated", "truth")
    return [f"+ /{root}/{part}/{pattern.replace('*', source)}" for pattern in patterns for source in sources]


def _wrench(rrb: Any, root: str) -> Any:
    kinds = (("force", "force of the fingers on the object [N]"), ("torque", "torque about the grasp centre [N·mm]"))
    return rrb.Vertical(
        *(
            rrb.TimeSeriesView(
                origin=f"{root}/wrench",
                contents=[*_of(root, "wrench", f"*/{kind}"), f"+ /{root}/wrench/estimated_2sigma/{kind}"],
                name=name,
            )
            for kind, name in kinds
        ),
        name="wrench",
    )


def _scene(rrb: Any, root: str, scene: Scene) -> Any:
    bounds = None
    if scene.box is not None:
        left, bottom, right, top = scene.box
        reach = [-(top + _MARGIN), -(min(bottom, 0.0) - _MARGIN)]  # y points down there
        bounds = rrb.VisualBounds2D(x_range=[left - _MARGIN, right + _MARGIN], y_range=reach)
    return rrb.Spatial2DView(origin=f"{root}/scene", name="scene", visual_bounds=bounds)


def _images(rrb: Any, root: str, names: Sequence[str]) -> Any:
    views = [rrb.Spatial2DView(origin=f"{root}/images/{name}", name=name) for name in names]
    return views[0] if len(views) == 1 else rrb.Grid(*views, name="pictures")


def _station(rrb: Any, scope: Scope, sensors: Sequence[str], arms: Sequence[str], images: Sequence[str]) -> Any:
    right = [
        rrb.TimeSeriesView(
            origin=STATION,
            contents=[f"+ /{STATION}/sensors/{name}/force" for name in sensors],
            name="force/torque sensors, as they measure [N]",
        ),
        rrb.TimeSeriesView(
            origin=STATION,
            contents=[f"+ /{STATION}/{name}/{what}/position" for name in arms for what in ("pose", "target")],
            name="arm: pose and set-points [mm]",
        ),
    ]
    if images:
        right.append(_images(rrb, STATION, images))
    return rrb.Horizontal(_scene(rrb, STATION, scope.scene), rrb.Vertical(*right), name=STATION)


def _text(rrb: Any) -> Any:
    return rrb.Horizontal(
        rrb.TextDocumentView(origin="overview", name="overview"),
        rrb.TextLogView(origin="log", name="trials, phases, events"),
        name="overview",
    )
