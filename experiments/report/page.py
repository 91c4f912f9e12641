"""Put the report's page together: tables from the results, scene and traces from the recorded trials."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.report import (
    calibration,
    calibration_table,
    convergence,
    device_health,
    payload,
    pictures,
    summary,
    traces,
)
from experiments.report.parts import HERE, environment, plotly, text

SCRIPTS = ("paper.js", "scene.js", "pictures.js", "player.js", "plots.js", "traces.js", "figures.js")


def render(data: Mapping[str, Any]) -> str:
    """One self-contained HTML page of a run; opened from disk it makes no request.

    ``data`` is JSON-able: ``results`` (results.json), ``title``, ``created``, ``objects`` (outlines in body frames
    [m]), ``grasp`` X_go_gocf, ``trials`` (waypoints and playback: poses (x, y, θ) in W, wrenches (fx, fy, τ) of the
    sensor on the go about the grasp centre, axes of W, contacts with point and force in W; SI), ``log``, ``events``,
    ``paper`` (see `summary.error_table`), ``plans`` (see `convergence.found`), ``health`` (see `device_health.told`), a
    trial's ``pictures`` (see `pictures.Strip.json`), ``imagers`` (the devices that take some), ``calibration`` (see
    `calibration_table.section`; ``only``: the run was to do nothing else). What is missing, None or NaN is left out and
    the page says so, so that an aborted, empty or torn run has its report as well. Raises TypeError when ``data`` is no
    mapping.
    """
    if not isinstance(data, Mapping):
        raise TypeError(f"render: expected a mapping with results, trials, objects …, got {type(data).__name__}")
    data = payload.clean(data)
    found = data.get("results")
    results: dict[str, Any] = found if isinstance(found, dict) else {}
    run = summary.mapping(data.get("calibration"))
    known = calibration_table.section(results.get("calibration"), run)
    searches = convergence.figures(data.get("plans"), results.get("plans"))
    drawn = [*(known["figures"] if known else []), *(figure for figure in searches if figure["data"])]
    for index, figure in enumerate(drawn):
        figure["index"] = index
    styles = {**calibration.styles(), **convergence.STYLES}
    drawings = payload.encode({"figures": [_drawing(figure) for figure in drawn], "styles": styles})
    shots = pictures.carried(summary.listed(data.get("trials")), data.get("imagers"))
    shown = payload.encode(shots) if any(shots["trials"]) or shots["imagers"] else ""
    carried = payload.build(data, reserved=len(shown) + (len(drawings) if drawn else 0))
    carried["figures"] = [traces.figure(trial) for trial in carried["trials"]]
    carried["styles"] = traces.styles()
    plotted = any(figure is not None for figure in carried["figures"])
    only_calibrates = bool(run.get("only")) and not carried["trials"] and not results.get("trials")
    made = run.get("made")
    provenance = results.get("provenance")
    return (
        environment()
        .get_template("report/template.html.j2")
        .render(
            title=str(data.get("title") or "Untitled run"),
            verdict=summary.verdict(results, len(made) if only_calibrates and isinstance(made, list) else None),
            facts=summary.facts(data),
            table=summary.error_table(results, data.get("paper")),
            plans=summary.plan_rows(results),
            calibration=known,
            only_calibrates=only_calibrates,
            provenance=list(summary.leaves(provenance)) if provenance else [],
            log=summary.log_summary(data.get("log"), len(results.get("trials") or [])),
            events=summary.event_rows(data.get("events")),
            searches=searches,
            devices=device_health.section(data.get("health"), data.get("events")),
            pictures=shown,
            trials=carried["trials"],
            playable=any(trial["playback"] is not None for trial in carried["trials"]),
            plotted=plotted,
            data=payload.encode(carried),
            drawings=drawings if drawn else "",
            style="",
            warnings=[],
            scripts={name: text(HERE, name) for name in SCRIPTS},
            plotly=plotly() if plotted or drawn else "",
        )
    )


def _drawing(figure: Mapping[str, Any]) -> dict[str, Any]:
    return {"data": figure["data"], "layout": figure["layout"], "wide": figure.get("wide", False)}
