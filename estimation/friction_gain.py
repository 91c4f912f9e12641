"""What the gains of a force sensor's axes do to the friction coefficient that it shows.

No sample shows a gain: it scales every ratio of forces alike. Its effect hangs on how the sensor lies to the contact. A
force along one of its axes keeps its direction whatever the gains are; one halfway between them turns the most.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from mechanics.readings import Array


def gain_sensitivity(ratio: ArrayLike, angle: ArrayLike) -> Array:
    """Relative change of ``ratio`` = f_t/f_n for a relative gain of the sensor's x axis above that of its y axis.

    ``angle`` [rad], counter-clockwise, of the sensor's axes in those of the contact, (t, n) = (x, y). With unit axes
    e_x, e_y and the contact force f a gain g_x adds g_x (e_x·f) e_x; a gain of both changes nothing.
    """
    ratio, angle = np.asarray(ratio, float), np.asarray(angle, float)
    along_t, along_n = np.cos(angle), np.sin(angle)  # of e_x
    return (along_t * ratio + along_n) * (along_t / ratio - along_n)


def shares(sensitivities: ArrayLike, gain_error: float, noise: float) -> tuple[Array, float]:
    """How much to believe each of several sensors (n,), summing to 1, and the relative error that is left, 1 sigma.

    ``sensitivities`` are those of the coefficient to each one's gains, ``gain_error`` is 1 sigma of an axis, relative.
    ``noise`` is what each leaves besides, relative, 1 sigma.
    """
    own = 2 * (np.asarray(sensitivities, float) * gain_error) ** 2 + noise**2
    share = 1 / own
    share = share / share.sum()
    return share, float(np.sqrt(share**2 @ own))
