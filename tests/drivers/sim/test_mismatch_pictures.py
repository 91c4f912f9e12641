"""The noise of pictures: anew in each trial and the same for every run of it, from a camera that stays as it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from drivers.config import ArmConfig, StationConfig, TactileConfig, TagCameraConfig, WorldConfig
from drivers.sim.mismatch import load_profile

from .profiles import device

FINGER = {"kind": "tactile", "finger": "left", "width": 64, "height": 48}
DEVICES: dict[str, Any] = {
    "soft_bubble": TactileConfig.model_validate(FINGER | {"sensor": "soft_bubble", "indentation": 0.016}),
    "gelslim": TactileConfig.model_validate(FINGER | {"sensor": "gelslim", "indentation": 0.0008}),
    "tag_camera": TagCameraConfig.model_validate(
        {"kind": "tag_camera", "width": 160, "height": 120, "focal": 175}
        | {"position": [0, -0.55, 0.07], "look_at": [0, 0, 0.07]}
    ),
}


@pytest.mark.parametrize("name", DEVICES)
def test_a_trials_pictures_have_noise_of_their_own_from_the_same_camera(world_of, name):
    devices = {"arm": ArmConfig(kind="arm"), name: DEVICES[name]}
    world = world_of(load_profile("lab"), config=StationConfig(name="sim", world=WorldConfig(), devices=devices))
    camera = device(world, name)

    def taken(trial: int, before: int = 0) -> np.ndarray:
        """The picture of an instant of the trial, after others that were taken."""
        world.regrasp(trial)
        for _ in range(before):
            camera.capture()
        world.regrasp(trial)
        seen = camera.capture()
        return (camera.image() if name == "tag_camera" else seen).image.astype(float)

    first, other, again = taken(4), taken(5), taken(4, before=2)
    # whatever was seen before; the bubble's membrane is found from where it was, and rounding may fall otherwise
    assert np.abs(again - first).max() <= 1 and np.mean(again != first) < 0.01
    assert np.mean(other != first) > 0.05, "other noise"


@pytest.mark.parametrize("name", ["soft_bubble", "gelslim"])
def test_a_fingers_constant_errors_are_the_seeds_and_not_the_trials(world_of, name):
    devices = {"arm": ArmConfig(kind="arm"), name: DEVICES[name]}
    world = world_of(load_profile("lab"), config=StationConfig(name="sim", world=WorldConfig(), devices=devices))
    untouched = []
    for trial in (3, 6):
        world.regrasp(trial)
        untouched.append(device(world, name).reference())
    np.testing.assert_array_equal(*untouched)
