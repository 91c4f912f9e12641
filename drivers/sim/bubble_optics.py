"""What the depth camera inside a Soft Bubble sees of its membrane.

The camera sits under the rim's plane and looks up into the dome; its x runs along the dome's long axis. A pixel whose
ray does not pass the rim has no depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from drivers.sim import bubble_kernels as kernels
from drivers.sim.bubble_geometry import DEPTH_UNIT, DOME, DepthCamera, Dome
from drivers.sim.bubble_membrane import Membrane
from mechanics.readings import Array


@dataclass
class BubbleView:
    """A membrane and the camera that looks at it; `depth` follows what is pressed on it."""

    camera: DepthCamera
    dome: Dome = DOME

    def __post_init__(self) -> None:
        #: the membrane and how it is deformed
        self.membrane = Membrane(self.dome)
        self._base = self.camera.distance - self.dome.top
        self._rays = self.camera.rays
        #: depth (height, width) [m] of the unpressed dome, NaN beyond its rim
        self.reference = self._undeformed()
        self._depth = self.reference.copy()
        self._touched = False

    def depth(self, outline: ArrayLike | None, indentation: float) -> Array:
        """Depth (height, width) [m] with a face pressed on the dome, or with nothing (None); a view.

        ``outline`` (N, 2) [m] is the face's polygon in the image's axes, from the dome's own. ``indentation`` [m] is
        how far the face is beyond the apex.
        """
        if outline is None:
            if self._touched:
                self.membrane.release()
                self._depth[:] = self.reference
                self._touched = False
            return self._depth
        self._touched = True
        self.membrane.press(outline, indentation)
        self.membrane.look(self._rays, self.reference, self._base, self.camera.shift, self._depth)
        return self._depth

    def _undeformed(self) -> Array:
        """Where each ray meets the ellipsoid, in closed form."""
        dome, shift, base = self.dome, self.camera.shift, self._base
        rx, ry = self._rays[0][None, :], self._rays[1][:, None]
        a2, b2, c2 = dome.a**2, dome.b**2, dome.top**2
        # ((rx z − shift)/a)² + (ry z/b)² + ((z − base)/top)² = 1, the farther root
        p = rx * rx / a2 + ry * ry / b2 + 1.0 / c2
        q = rx * shift / a2 + base / c2
        r = shift * shift / a2 + base * base / c2 - 1.0
        z = (q + np.sqrt(np.maximum(q * q - p * r, 0.0))) / p
        inside = ((rx * base - shift) ** 2 / a2 + (ry * base) ** 2 / b2) < 1.0
        return np.where(inside, z, np.nan)


def quantised(depth: NDArray) -> NDArray[np.uint16]:
    """A depth image [m] in `DEPTH_UNIT`; 0 where there is no depth."""
    out = np.empty(depth.shape, np.uint16)
    kernels.quantise(depth, DEPTH_UNIT, out)
    return out
