"""The steps of a tag camera: its picture, the tags in it, and whether they are where the station file has them."""

from __future__ import annotations

import cv2
import numpy as np

from experiments.calibrate import store
from experiments.calibrate.models import CameraCalibration
from experiments.check_device.bench import Bench, Step
from experiments.check_device.findings import Finding, judged
from experiments.check_device.pictures import exposure
from mechanics.camera import CameraModel, TagGeometry, point_in_world
from mechanics.readings import TagReading
from mechanics.yaml_input import InputError

#: the least variance of the Laplacian of a picture that is in focus (grey levels²)
SHARP = 20.0
#: how far a tag may be from where the camera's model has it [px]
OFF = 2.0


def _picture(bench: Bench) -> Finding:
    bench.device.capture()
    reading = bench.device.image()
    if reading is None:
        return judged(False, "it keeps no picture", "See to its backend")
    height, width = reading.image.shape[:2]
    grey = reading.image if reading.image.ndim == 2 else cv2.cvtColor(reading.image, cv2.COLOR_BGR2GRAY)
    told = bench.describe().extra["camera"]
    if (width, height) != (told["width"], told["height"]):
        return judged(False, f"{width} × {height} px, not {told['width']} × {told['height']}", "Correct width, height")
    light, good, remedy = exposure(grey)
    sharp = float(cv2.Laplacian(grey, cv2.CV_64F).var())
    if good and sharp < SHARP:
        good, remedy = False, "Focus the lens on the tags, and lock it; shorten the exposure where things move"
    measured = f"{width} × {height} px; {light}; sharpness {sharp:.0f}, at least {SHARP:g}"
    return judged(good, measured, remedy, sharpness=sharp, brightness=float(grey.mean()))


def _seen(bench: Bench) -> TagReading:
    return bench.device.capture()


def _tags(bench: Bench) -> Finding:
    seen = {tag.id: tag.margin for tag in _seen(bench).detections}
    expected = {mount.id for mount in bench.opened.config.table_tags}
    missing = sorted(expected - set(seen))
    others = sorted(set(seen) - expected)
    said = [f"{len(expected) - len(missing)} of {len(expected)} of the table"] if expected else []
    said += [f"missing {', '.join(map(str, missing))}"] if missing else []
    said += [f"besides {', '.join(map(str, others))}"] if others else []
    said += [f"margins from {min(seen.values()):.0f}"] if seen else ["no tag at all"]
    remedy = "Turn the camera so that it sees them; see to their `family`, to light and focus"
    return judged(bool(seen) and not missing, "; ".join(said), remedy, tags=sorted(seen))


def _believed(bench: Bench) -> tuple[CameraModel, str]:
    """The camera as it was calibrated on this station, else as the station file has it; and in words, which it is.

    Raises InputError for a file that is no calibration.
    """
    config, said = bench.opened.config, bench.describe()
    file = store.FOLDER / config.name / "camera.yaml"
    if config.world is None and file.is_file():
        found = store.read(file)
        serial = config.devices[bench.opened.name].serial
        if isinstance(found, CameraCalibration) and found.origin.devices.get(bench.opened.name) == serial:
            return found.model, f"as calibrated on {found.origin.made:%Y-%m-%d}"
    return CameraModel.from_dict(said.extra["camera"]), "as the station file has it"


def _reprojection(bench: Bench) -> Finding:
    try:
        model, which = _believed(bench)
    except InputError as error:
        return judged(False, str(error), "Calibrate the camera again (docs/calibrate.md), or take the file away")
    mounts = {mount.id: mount for mount in bench.opened.config.table_tags}
    off: dict[int, float] = {}
    for tag in _seen(bench).detections:
        if (mount := mounts.get(tag.id)) is not None:
            corners = TagGeometry(mount.id, mount.size, mount.pose, mount.height).corners
            expected = model.project(point_in_world(corners, mount.height))
            off[tag.id] = float(np.sqrt(((expected - tag.corners) ** 2).sum(axis=1).mean()))
    if not off:
        return judged(False, "no tag of the table is in view", "See the step before")
    told = f"{', '.join(f'tag {id} {error:.1f} px' for id, error in sorted(off.items()))}, the camera {which}"
    remedy = (
        "Measure the tags' places (`table_tags`) and the camera's (`position`, `look_at`, or `X_WC`), then calibrate "
        "it (docs/calibrate.md)"
    )
    figures = {str(id): error for id, error in off.items()}
    return judged(max(off.values()) <= OFF, f"{told}; {OFF:g} px are allowed", remedy, off_px=figures)


STEPS = (
    Step("picture", "its size, light and focus", _picture, asks=True),
    Step("tags", "which tags it sees", _tags, asks=True),
    Step("reprojection", "how far the table's tags are from where it should see them", _reprojection, asks=True),
)
