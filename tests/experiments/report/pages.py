"""What hands do at a page, and what eyes see there."""

import math

import pytest


def seek(page, t):
    """Move the slider as a hand would: set it and let it tell."""
    page.locator("#time").evaluate("(slider, t) => { slider.value = t; slider.dispatchEvent(new Event('input')); }", t)


def draw_traces(page):
    page.locator("#traces-title").scroll_into_view_if_needed()
    page.wait_for_selector("#traces .scatterlayer .trace")


def wait_until(page, condition):
    """Wait for a condition on the page, looked at once per frame."""
    page.evaluate(
        f"new Promise((done) => {{ const look = () => ({condition}) ? done() : requestAnimationFrame(look); look(); }})"
    )


def pose(page, body):
    """[x, y, θ in degrees] of a drawn body, and None where it is not shown."""
    node = page.locator(f".body-{body}")
    if not node.is_visible():
        return None
    text = node.get_attribute("transform")
    return [
        float(v) for part in text.replace(")", "").split(" rotate(") for v in part.replace("translate(", "").split()
    ]


def expect_pose(page, body, wanted):
    assert pose(page, body) == pytest.approx([wanted[0], wanted[1], math.degrees(wanted[2])], abs=1e-4)


def draw_figures(page, which="[data-figure]"):
    for plot in page.locator(which).all():
        plot.scroll_into_view_if_needed()
        plot.locator(".scatterlayer .trace").first.wait_for(state="attached")


def draw_calibrations(page):
    draw_figures(page, ".calibration-plot")
