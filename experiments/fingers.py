"""The tactile fingers of a station, and how their pictures are read."""

from __future__ import annotations

from control.observe import Finger
from drivers.config import TactileConfig
from drivers.roles import Roles
from estimation.tactile_pose import FingerModel, TactilePoseEstimator
from experiments.files import Resolved


def method(model: FingerModel, resolved: Resolved) -> TactilePoseEstimator:
    """The better of the methods for this kind of finger."""
    outline = resolved.grasped.polygon
    if model.sensor == "gelslim":
        from estimation.tactile_pose_gel import TactilePoseGel

        return TactilePoseGel(model, outline)
    from estimation.tactile_pose_strips import RidgeStrips

    return RidgeStrips(model, outline)


def fingers(resolved: Resolved, devices: Roles) -> tuple[Finger, ...]:
    """Every tactile finger of the station, with its untouched picture taken."""
    found = []
    for name, config in resolved.station.devices.items():
        if isinstance(config, TactileConfig):
            sensor = devices.tactile(config.finger)
            model = FingerModel.of(devices[name].describe().extra, sensor.reference())
            found.append(Finger(sensor, method(model, resolved)))
    return tuple(found)
