"""How a force/torque sensor finds its zero: the mean of the readings that come next, if all of them are good."""

from __future__ import annotations

import numpy as np

from mechanics.readings import Array, Status


class Tare:
    """Gathers ``wanted`` readings. A stale one is passed over; one that cannot be trusted refuses the tare."""

    def __init__(self, wanted: int):
        self.wanted, self.loads = wanted, list[Array]()
        #: why it cannot be; "" where nothing is against it
        self.refused = ""

    @property
    def done(self) -> bool:
        """Whether nothing more is waited for."""
        return self.refused != "" or len(self.loads) == self.wanted

    @property
    def zero(self) -> Array:
        """The mean of what was gathered (6,)."""
        return np.mean(self.loads, axis=0)

    def take(self, wrench: Array, status: Status, said: str = "") -> bool:
        """Take a reading (6,), before any zero; ``said`` is why its status is not OK. True for the last one wanted."""
        if self.done or status is Status.STALE:
            return False
        if status is not Status.OK:
            self.refused = f"a reading is {status.name.lower()}: {said}"
            return False
        self.loads.append(wrench)
        return self.done
