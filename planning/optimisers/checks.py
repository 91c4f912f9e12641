"""What every optimiser refuses: a start at which there is nothing to improve on."""

from __future__ import annotations

import numpy as np

from mechanics.readings import Array
from planning.optimisers.base import Objective


def checked_start(name: str, objective: Objective, z: Array) -> Array:
    """Return ``z`` (K, D) as an array of its own. Raises ValueError that names a wrong shape or a number that is none.

    ``name`` is the optimiser's, for the message.
    """
    z = np.array(z, dtype=float)
    if z.shape != objective.free.shape:
        raise ValueError(f"{name}: start: expected z of shape {objective.free.shape}, received {z.shape}")
    wrong = np.argwhere(~np.isfinite(z))
    if len(wrong):
        step, variable = wrong[0]
        raise ValueError(
            f"{name}: start: expected finite numbers, received {z[step, variable]} in step {step}, variable {variable}"
        )
    return z


def require_finite(name: str, value: float) -> None:
    """Raise ValueError where the loss ``value`` at the start is not finite."""
    if not np.isfinite(value):
        raise ValueError(
            f"{name}: start: expected a finite loss, received {value}: the start lies behind a barrier (penetration, "
            "workspace, joints, sensor) or one of its steps has no forces; start from what the skill proposes"
        )
