"""Put a campaign's page together: the run's style, tables, and figures that the page draws itself."""

from __future__ import annotations

from experiments.campaign.report import points, tables
from experiments.campaign.report.collect import Collected
from experiments.report import parts, payload

HERE = "experiments.campaign.report"


def render(collected: Collected) -> str:
    """One self-contained HTML page of a campaign; opened from disk it makes no request.

    Its links lead to the reports of the runs, as seen from the campaign's folder.
    """
    figures = {
        name: figure
        for name, figure in (
            ("distributions", points.distributions(collected)),
            ("differences", points.differences(collected)),
        )
        if figure is not None
    }
    return (
        parts.environment()
        .get_template("campaign/report/template.html.j2")
        .render(
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
            figures=figures,
            data=payload.encode(payload.clean(figures)),
            style=style(),
            plots=parts.text(parts.HERE, "plots.js"),
            script=parts.text(HERE, "points.js"),
            plotly=parts.plotly() if figures else "",
        )
    )


def style() -> str:
    """What a campaign's page has besides the style of every page."""
    return parts.text(HERE, "campaign.css")
