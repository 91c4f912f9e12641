"""Where calibration files lie, and which of them a run may use.

``calibrations/<station>/`` in the current folder belongs to one station; a simulated one differs by its world and
seed, as laboratories differ, so `calibrations/sim-lab-0/` is that of seed 0 of profile `lab`. The newest file of a kind
stands under its name; those before it are kept beside it under the time they were made. Nothing recorded is lost.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from experiments.calibrate.models import (
    Calibration,
    CameraCalibration,
    ClockCalibration,
    ElasticityCalibration,
    ForceTorqueCalibration,
    FrictionCalibration,
    Origin,
    TagCalibration,
    fingerprint,
    friction_name,
    tag_name,
)
from experiments.calibrate.schema import FrictionStage
from experiments.files import Resolved, laid_out
from experiments.provenance import revision
from experiments.run_folder import write_atomic
from mechanics.yaml_input import InputError, Problem, parse, read_yaml

FOLDER = Path("calibrations")
_KINDS = {
    model.model_fields["kind"].default: model
    for model in (
        ElasticityCalibration,
        FrictionCalibration,
        ForceTorqueCalibration,
        CameraCalibration,
        TagCalibration,
        ClockCalibration,
    )
}


@dataclass
class Calibrations:
    """What is known of a station, by file name; ``files`` says where each was read or written."""

    known: dict[str, Calibration] = field(default_factory=dict)
    files: dict[str, Path] = field(default_factory=dict)

    def __iter__(self) -> Iterator[Calibration]:
        return iter(self.known.values())

    def add(self, calibration: Calibration, file: Path) -> None:
        """Know this from now on, instead of what was known under its name."""
        self.known[calibration.name] = calibration
        self.files[calibration.name] = file

    def told(self) -> dict[str, dict[str, Any]]:
        """Each calibration as results.json has it: its file, and all that the file says."""
        return {name: {"file": str(self.files[name]), **c.model_dump(mode="json")} for name, c in self.known.items()}

    @classmethod
    def of_told(cls, told: Mapping[str, Mapping[str, Any]]) -> Calibrations:
        """Those that `told` has put into results.json. Raises ValueError (pydantic's) for what it has not."""
        known = cls()
        for said in told.values():
            figures = {key: value for key, value in said.items() if key != "file"}
            known.add(_KINDS[said["kind"]].model_validate_json(json.dumps(figures)), Path(said["file"]))
        return known

    def of(self, kind: type, name: str | None = None) -> Any:
        """The calibration ``name`` (by default its kind's name) if it is known and of ``kind``, else None."""
        found = self.known.get(name or kind.model_fields["kind"].default)
        return found if isinstance(found, kind) else None

    def elasticity(self, resolved: Resolved) -> ElasticityCalibration | None:
        """That of the experiment's sensor with its object."""
        return self.of(ElasticityCalibration, f"elasticity-{resolved.sensor.name}-{resolved.grasped.name}")

    def tags(self, resolved: Resolved) -> dict[int, TagCalibration]:
        """Those of the grasped object's tags, by id."""
        seats = [self.of(TagCalibration, name) for name in _tag_names(resolved)]
        return {seat.id: seat for seat in seats if seat is not None}

    def friction(self, resolved: Resolved) -> dict[str, FrictionCalibration]:
        """By pair, for those pairs of the experiment that are known."""
        objects = prints(resolved)
        found = {pair: self.of(FrictionCalibration, friction_name(pair, objects)) for pair in resolved.friction}
        return {pair: calibration for pair, calibration in found.items() if calibration is not None}


def prints(resolved: Resolved) -> dict[str, str]:
    """Fingerprints of the experiment's objects by role."""
    shapes = {"go": resolved.grasped, "eo": resolved.extrinsic}
    return {role: fingerprint(shape) for role, shape in shapes.items() if shape is not None}


def world_of(resolved: Resolved) -> dict[str, Any] | None:
    """What tells one simulated laboratory from another; None for a real station."""
    world = resolved.station.world
    if world is None:
        return None
    return {"profile": world.profile, "seed": resolved.experiment.seed, "stiffness_scale": world.stiffness_scale}


def folder_of(resolved: Resolved) -> Path:
    """The folder of the experiment's station."""
    source = resolved.experiment.calibration.source
    if source not in ("auto", "none"):
        return Path(source)
    world, name = world_of(resolved), resolved.station.name
    if world is None:
        return FOLDER / name
    scale = "" if world["stiffness_scale"] == 1 else f"-x{world['stiffness_scale']:g}"
    return FOLDER / f"{name}-{Path(world['profile']).stem}{scale}-{world['seed']}"


def origin(resolved: Resolved, devices: tuple[str, ...], roles: tuple[str, ...], run: str) -> Origin:
    """Where a calibration comes from that is made now with ``devices`` and the objects in ``roles``."""
    every = prints(resolved)
    return Origin(
        made=datetime.now(UTC).replace(microsecond=0),
        station=resolved.station.name,
        world=world_of(resolved),
        devices={name: resolved.station.devices[name].serial for name in devices},
        objects={role: every[role] for role in roles},
        run=run,
        revision=revision(),
    )


def dumped(calibration: Calibration) -> str:
    """The file's text."""
    yaml, out = YAML(), io.StringIO()
    yaml.width = 120
    yaml.dump(laid_out(calibration.model_dump(mode="json")), out)
    return out.getvalue()


def save(folder: Path, calibration: Calibration) -> Path:
    """Write ``calibration`` under its name; what stood there moves beside it, under the time it was made."""
    folder.mkdir(parents=True, exist_ok=True)
    file = folder / f"{calibration.name}.yaml"
    if file.exists():
        at = read(file).origin.made
        file.rename(_free(folder / f"{calibration.name}.{at:%Y%m%dT%H%M%S}.yaml"))
    write_atomic(file, dumped(calibration))
    return file


def _free(path: Path) -> Path:
    """``path``, or one like it that no file has."""
    number, candidate = 1, path
    while candidate.exists():
        number += 1
        candidate = path.with_name(f"{path.stem}-{number}{path.suffix}")
    return candidate


def read(file: Path) -> Calibration:
    """One calibration file. Raises InputError."""
    document = read_yaml(file)
    kind = document.data.get("kind")
    if not isinstance(kind, str) or kind not in _KINDS:
        raise InputError([document.problem(("kind",), f"{kind!r:.60} is no kind of calibration", ", ".join(_KINDS))])
    return parse(_KINDS[kind], document)


def load(resolved: Resolved) -> Calibrations:
    """The calibrations that the experiment may use, by its `calibration` key; a folder that it fills may be missing.

    Raises InputError that names each file which is of another station, device or object, or too old. One that a stage
    of the experiment makes anew is left out instead: to calibrate again is what the refusal asks for.
    """
    found = Calibrations()
    use = resolved.experiment.calibration
    if use.source == "none":
        return found
    folder = folder_of(resolved)
    if not folder.is_dir():
        makes_it = any(stage.stage.startswith("calibrate_") for stage in resolved.experiment.stages)
        if use.source != "auto" and not makes_it:
            wrong = f"there is no folder {folder}"
            expected = "auto, none, or a folder of calibration files"
            raise InputError([resolved.experiment_document.problem(("calibration", "source"), wrong, expected)])
        return found
    problems, remade = list[Problem](), made_by(resolved)
    for name in wanted(resolved):
        file = folder / f"{name}.yaml"
        if not file.is_file():
            continue
        calibration = read(file)
        refused = _problems(resolved, calibration, file)
        if refused and name in remade:
            continue
        problems += refused
        found.add(calibration, file)
    if problems:
        raise InputError(problems)
    return found


def _tag_names(resolved: Resolved) -> list[str]:
    return [tag_name(resolved.grasped.name, tag.id) for tag in resolved.grasped.all_tags]


def wanted(resolved: Resolved) -> list[str]:
    """The names of the files that this experiment has a use for."""
    objects = prints(resolved)
    return [
        f"elasticity-{resolved.sensor.name}-{resolved.grasped.name}",
        *(friction_name(pair, objects) for pair in resolved.friction),
        *_tag_names(resolved),
        "force_torque",
        "camera",
        "clock",
    ]


def made_by(resolved: Resolved) -> set[str]:
    """The names of the files that this experiment's own stages write."""
    held, objects = resolved.grasped.name, prints(resolved)
    written = {
        "calibrate_force_torque": ["force_torque"],
        "calibrate_camera": ["camera", *_tag_names(resolved)],
        "calibrate_clock": ["clock"],
        "calibrate_elasticity": [f"elasticity-{resolved.sensor.name}-{held}"],
    }
    names: set[str] = set()
    for stage in resolved.experiment.stages:
        if isinstance(stage, FrictionStage):
            names.add(friction_name(stage.pair, objects))
        else:
            names.update(written.get(stage.stage, ()))
    return names


def _problems(resolved: Resolved, calibration: Calibration, file: Path) -> list[Problem]:
    made, station = calibration.origin, resolved.station
    again = f"run the calibration again, or leave it out: --set calibration.source=none ({file.name})"
    problems: list[Problem] = []

    def refuse(key: str, wrong: str) -> None:
        problems.append(Problem(str(file), None, key, wrong, again))

    if made.station != station.name:
        refuse("origin.station", f"it is of station '{made.station}', this run is on '{station.name}'")
    if made.world != world_of(resolved):
        refuse("origin.world", f"it is of the world {_said(made.world)}, this run is in {_said(world_of(resolved))}")
    for name, serial in made.devices.items():
        here = station.devices.get(name)
        if here is None:
            refuse(f"origin.devices.{name}", f"the station has no device '{name}'")
        elif here.serial != serial:
            refuse(f"origin.devices.{name}", f"it is of serial '{serial}', the station's '{name}' is '{here.serial}'")
    here_are = set(prints(resolved).values())
    for role, object_ in made.objects.items():
        if object_ not in here_are:
            refuse(f"origin.objects.{role}", f"it is of the object '{object_}', this run has {sorted(here_are)}")
    if made.age_days > resolved.experiment.calibration.max_age_days:
        limit = resolved.experiment.calibration.max_age_days
        refuse("origin.made", f"it is {made.age_days:.0f} days old, calibration.max_age_days is {limit:g}")
    return problems


def _said(world: Mapping[str, Any] | None) -> str:
    return "the real one" if world is None else ", ".join(f"{key} {value}" for key, value in world.items())
