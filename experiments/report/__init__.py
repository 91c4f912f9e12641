"""The report of a run: one HTML file that shows what happened and works without a network."""

from experiments.report.page import render

__all__ = ["render"]
