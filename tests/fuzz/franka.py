"""The model (URDF) that comes from a Franka, or from whoever stands at its address."""

from __future__ import annotations

import numpy as np

from drivers.real.franka_motion import joint_limits

WORDS = (b"<limit ", b'lower="', b'upper="', b"<joint ", b'type="revolute"', b'<!ENTITY a "b">', b"&a;", b"nan", b"inf")
_JOINT = '<joint name="joint{0}" type="revolute"><limit effort="87" lower="-2.{0}" upper="2.{0}" velocity="2"/></joint>'


def models() -> list[bytes]:
    """A robot of seven joints."""
    joints = "".join(_JOINT.format(i) for i in range(1, 8))
    return [f'<?xml version="1.0"?><robot name="fr"><link name="base"/>{joints}</robot>'.encode()]


def take_model(data: bytes) -> None:
    """What is read is seven spans of finite angles."""
    low, high = joint_limits("arm", data.decode("utf-8", "replace"))
    assert low.shape == high.shape == (7,)
    assert np.isfinite(low).all() and np.isfinite(high).all() and (low < high).all()
