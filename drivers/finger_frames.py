"""How the tactile fingers sit at the end-effector, and how the cameras in them look at what touches."""

from __future__ import annotations

import numpy as np

from mechanics.camera import CameraModel
from mechanics.readings import Array

X_EE_FINGER = {
    "left": ((1.0, 0, 0, 0), (0, 0, -1.0, 0), (0, 1.0, 0, 0), (0, 0, 0, 1.0)),
    "right": ((-1.0, 0, 0, 0), (0, 0, 1.0, 0), (0, 1.0, 0, 0), (0, 0, 0, 1.0)),
}
"""Poses (4, 4) of the fingers' frames in ee, whose 3-D axes are X right, Y away from the viewer, Z up.

x and y of a finger's frame are right and up as one sees the object from it, z points from the object into the finger.
"""

DEPTH_UNIT = 1e-4
"""One step of a Soft Bubble's depth picture [m]."""

BUBBLE_DOME = (0.0557, 0.0406, 0.041)
"""A Soft Bubble's unpressed dome, as measured: semi-axes along the camera's x and y, height over its rim [m]."""

BUBBLE_DISTANCE, BUBBLE_SHIFT = 0.1, 0.021
"""Of a Soft Bubble's camera to the dome's apex; of the dome's axis from a RealSense's, along the picture's x [m]."""

REALSENSE_FOCAL = 434.0
"""Focal length of a RealSense's depth pictures of 640 columns, about [px]; those of w columns have w / 640 of it."""


def bubble_camera_pose(distance: float, shift: float) -> Array:
    """Pose X_FC (4, 4) of a Soft Bubble's camera in the finger's frame, whose origin is the unpressed dome's apex.

    The camera's x is y of F, along the dome's long axis, and its y is x of F. ``distance`` [m] is from the camera to
    the apex along the optical axis; the dome's axis lies ``shift`` [m] from it along the picture's x.
    """
    return np.array([[0, 1, 0, 0], [1, 0, 0, -shift], [0, 0, -1, distance], [0, 0, 0, 1]], float)


def gel_camera(width: int, height: int, *, view: float, distance: float, tilt: float, bend: float) -> CameraModel:
    """The camera behind a gel, with a picture of ``width`` × ``height`` [px]; its world is the finger's frame.

    It stands ``distance`` [m] above the gel, tilted by ``tilt`` [rad] so that it sees the lower rows from nearer, and
    sees ``view`` [m] across the picture's width; ``bend`` is the radial distortion k1.
    """
    focal = width * distance / view
    c, s = np.cos(tilt), np.sin(tilt)
    X_FC = np.eye(4)
    X_FC[:3, :3] = np.column_stack(((1, 0, 0), (0, -c, -s), (0, s, -c)))  # it looks along −z, slightly up
    X_FC[:3, 3] = -distance * X_FC[:3, 2]
    K = np.array([[focal, 0, 0.5 * (width - 1)], [0, focal, 0.5 * (height - 1)], [0, 0, 1]])
    return CameraModel(width, height, K, np.array([bend, 0, 0, 0, 0]), X_FC)
