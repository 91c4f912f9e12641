"""Put a campaign's page together: the run's style, tables, and figures that the page draws itself."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from experiments.campaign.report import points, tables
from experiments.campaign.report.collect import Collected
from experiments.report import parts, payload

HERE = "experiments.campaign.report"


def render(collected: Collected) -> str:
    """One self-contained HTML page of a campaign; opened from disk it makes no request.

    Its links lead to the reports of the runs, as seen from the campaign's folder.
    """
    return filled(
        "campaign/report/template.html.j2",
        figures_of(collected),
        title=f"Sweep of {collected.summary.get('experiment') or 'an experiment'}",
        verdict=tables.verdict(collected),
        facts=tables.facts(collected),
        warnings=tables.warnings(collected),
        missing=collected.missing,
        given_up=collected.given_up,
        cells=tables.cell_rows(collected),
        differences=tables.difference_rows(collected),
        failures=tables.failure_rows(collected),
        worst=tables.worst(collected),
        trials=tables.trial_rows(collected),
        provenance=list(tables.provenance_rows(collected)),
    )


def figures_of(collected: Collected) -> dict[str, Any]:
    """The figures in which there is something to draw, by the name of their section."""
    found = {"distributions": points.distributions(collected), "differences": points.differences(collected)}
    return {name: figure for name, figure in found.items() if figure is not None}


def filled(template: str, figures: Mapping[str, Any], **told: Any) -> str:
    """A template filled in: with what a campaign's page has besides every page's style, and draws ``figures``."""
    own = {
        "style": parts.text(HERE, "campaign.css"),
        "figures": figures,
        "data": payload.encode(payload.clean(figures)),
        "plots": parts.text(parts.HERE, "plots.js"),
        "script": parts.text(HERE, "points.js"),
        "plotly": parts.plotly() if figures else "",
    }
    return parts.environment().get_template(template).render(**own, **told)
