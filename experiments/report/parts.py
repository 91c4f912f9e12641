"""What pages are put together from: the texts beside a package's code, the plotting library, the templates' engine."""

from __future__ import annotations

from functools import cache
from importlib.resources import files
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jinja2 import Environment

#: where the style, the scripts and the template of a run's report lie
HERE = "experiments.report"


def text(package: str, name: str) -> str:
    """The file ``name`` of a ``package``."""
    return (files(package) / name).read_text(encoding="utf-8")


@cache
def plotly() -> str:
    """The plotting library, as it may stand within a script element."""
    from plotly.offline import get_plotlyjs

    # Only inside strings can these occur, where the backslash changes nothing.
    return get_plotlyjs().replace("</script", "<\\/script").replace("<!--", "<\\!--")


@cache
def environment() -> Environment:
    """What fills templates in: everything escaped, and a name that is missing is an error.

    A template is named by its path within `experiments`. ``frame`` is what every page begins with (`base.html.j2`).
    """
    from jinja2 import Environment, FunctionLoader, StrictUndefined

    settings = {"autoescape": True, "undefined": StrictUndefined, "trim_blocks": True, "lstrip_blocks": True}
    made = Environment(loader=FunctionLoader(lambda name: text("experiments", name)), **settings)
    made.globals["frame"] = {name.partition(".")[0]: text(HERE, name) for name in ("style.css", "dark.css", "theme.js")}
    return made
