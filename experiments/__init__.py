"""Experiment files, the runner, metrics, the report and the command line; from Python: ``from experiments import run``.

Everything heavy is imported when it is first asked for.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from experiments.interface import Run, RunFailed, run

#: of all of extrinsic: the distribution takes it from here
__version__ = "0.1.0"

__all__ = ["Run", "RunFailed", "__version__", "run"]


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from experiments import interface

    return getattr(interface, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
