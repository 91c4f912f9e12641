"""From the names on the command line to a resolved experiment: files found, ``--set`` applied, references followed.

Nothing here touches a device. Whatever is wrong is an InputError with its file, line and key.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import BaseModel
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedSeq

import experiments
from drivers.config import StationConfig, TactileConfig
from drivers.sim.mismatch import load_profile, profile_names
from experiments import shipped
from experiments.schema import Experiment
from mechanics import model_paths
from mechanics.catalogue import CATALOGUE, SENSORS, ObjectModel, SensorModel, load_sensor
from mechanics.readings import Array
from mechanics.yaml_input import (
    Document,
    InputError,
    Problem,
    dotted,
    locate,
    nearest,
    one_of,
    parse,
    read_yaml,
    set_key,
)

PACKAGE = Path(experiments.__file__).parent
EXPERIMENTS = (PACKAGE, PACKAGE.parent)  # the latter for `experiments/grasped_pivoting.yaml` from anywhere
STATIONS = (Path("stations"), PACKAGE / "stations", PACKAGE)

#: where fingers hold a tall box by default, above its centroid [mm]: an end of it stays in the picture; and a side with
#: it, which the smaller picture of a GelSlim needs
CENTRE_MM, GEL_CENTRE_MM = (0.0, 45.0), (10.0, 62.0)

_SET_FORM = "key=value, such as trial.ramp=0.3"


@dataclass(frozen=True)
class Resolved:
    """An experiment and its station, with every reference followed. ``grasp`` is X_go_gocf (3,), SI.

    ``friction`` has a coefficient for each pair that can touch.
    """

    experiment: Experiment
    station: StationConfig
    grasped: ObjectModel
    extrinsic: ObjectModel | None
    sensor: SensorModel
    experiment_document: Document = field(repr=False)
    station_document: Document = field(repr=False)

    @property
    def grasp(self) -> Array:
        """X_go_gocf (3,) = (x, y, θ) [m, m, rad]."""
        grasp = self.experiment.grasp
        return np.array([*(v * 1e-3 for v in self.grasp_centre_mm), np.radians(grasp.angle_deg)])

    @property
    def grasp_centre_mm(self) -> tuple[float, float]:
        """Where the fingers hold the object, in its frame; what ``auto`` comes to with the station's fingers."""
        asked = self.experiment.grasp.centre_mm
        if asked != "auto":
            return asked
        return GEL_CENTRE_MM if finger_kinds(self.station) == ("gelslim",) else CENTRE_MM

    @property
    def friction(self) -> dict[str, float]:
        """Coulomb coefficients by pair: the objects' own (the smaller of two), then what the experiment says."""
        own = {"go-ground": self.grasped.friction}
        if self.extrinsic is not None:
            own["go-eo"] = min(self.grasped.friction, self.extrinsic.friction)
            own["eo-ground"] = self.extrinsic.friction
        return {**own, **self.experiment.friction}


def load(experiment: str, station: str | None = None, sets: Sequence[str] = ()) -> Resolved:
    """Read an experiment and its station (``station``, or the one that the experiment names) and resolve both.

    ``sets`` are ``key=value`` overrides: a key goes to the file whose schema has it; ``experiment.`` or ``station.``
    in front decides where both have it. Accepts what `dump_resolved` wrote, too. Raises InputError.
    """
    besides = shipped.no_experiments()
    document = read_yaml(locate(experiment, "experiment", EXPERIMENTS, EXPERIMENTS[:1], besides))
    embedded: Document | None = None
    if set(document.data) == {"experiment", "station"} and isinstance(document.data["experiment"], dict):
        document, embedded = document.part("experiment"), document.part("station")
    overrides = [_split(text) for text in sets]
    for key, value in overrides:
        if key in ("station", "experiment.station"):  # which station it is decides what the other keys mean
            document, embedded = set_key(document, "station", value), None
    station_document = embedded
    if station is not None:
        station_document = read_yaml(locate(station, "station", STATIONS, STATIONS[:2]))
    elif station_document is None:
        station_document = _followed(document, "station", "station", STATIONS, STATIONS[:2], "sim")
    for key, value in overrides:
        if key not in ("station", "experiment.station"):
            document, station_document = _applied(document, station_document, key, value)
    model = parse(Experiment, document)
    config = parse(StationConfig, station_document)
    resolved = Resolved(
        model,
        config,
        _object(document, "grasped_object", model.grasped_object),
        None if model.extrinsic_object is None else _object(document, "extrinsic_object", model.extrinsic_object),
        _sensor(document, model.sensor, config),
        document,
        station_document,
    )
    problems = [*_world_problems(config, station_document), *_tag_problems(resolved), *_grasp_problems(resolved)]
    if problems:
        raise InputError(problems)
    return resolved


def load_station(station: str, sets: Sequence[str] = (), only: Sequence[str] | None = None) -> StationConfig:
    """Read a station alone, for commands that take no experiment; ``only`` names the devices to keep.

    Raises InputError.
    """
    document = read_yaml(locate(station, "station", STATIONS, STATIONS[:2]))
    for key, value in map(_split, sets):
        document = _set(StationConfig, document, key, key.removeprefix("station.").split("."), value)
    config = parse(StationConfig, document)
    problems = _world_problems(config, document)
    for name in only or ():
        if name not in config.devices:
            wrong = f"the station has no device {name!r}"
            problems.append(
                document.problem(("devices",), wrong, one_of(config.devices), nearest(name, config.devices))
            )
    if problems:
        raise InputError(problems)
    kept = {name: device for name, device in config.devices.items() if only is None or name in only}
    return config.model_copy(update={"devices": kept})


def dump_resolved(resolved: Resolved) -> str:
    """Experiment and station as YAML with every default and every referenced file filled in; `load` reads it back."""
    inlined: dict[str, Any] = {"sensor": resolved.sensor, "grasped_object": resolved.grasped}
    if resolved.extrinsic is not None:
        inlined["extrinsic_object"] = resolved.extrinsic
    inlined["grasp"] = resolved.experiment.grasp.model_copy(update={"centre_mm": resolved.grasp_centre_mm})
    experiment = resolved.experiment.model_copy(update=inlined)
    data = {"experiment": experiment.model_dump(mode="json"), "station": resolved.station.model_dump(mode="json")}
    yaml = YAML()
    yaml.width = 120
    out = io.StringIO()
    yaml.dump(laid_out(data), out)
    return out.getvalue()


def laid_out(value: Any) -> Any:
    """Lists of figures or names on one line, everything else in blocks."""
    if isinstance(value, dict):
        return {key: laid_out(item) for key, item in value.items()}
    if not isinstance(value, list):
        return value
    sequence = CommentedSeq(laid_out(item) for item in value)
    if not any(isinstance(item, dict | list) for item in value):
        sequence.fa.set_flow_style()
    return sequence


# -- --set -----------------------------------------------------------------------------------------------------------


def _split(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key.strip():
        raise InputError([Problem("--set", None, "", f"{text!r} is no setting", _SET_FORM)])
    return key.strip(), value


def _applied(experiment: Document, station: Document, key: str, value: str) -> tuple[Document, Document]:
    """Both documents, ``key`` set in the one whose schema has it."""
    path = key.split(".")
    if path[0] in ("experiment", "station") and len(path) > 1:
        rest = path[1:]
        if path[0] == "experiment":
            return _set(Experiment, experiment, key, rest, value), station
        return experiment, _set(StationConfig, station, key, rest, value)
    in_experiment = model_paths.exists(Experiment, path, experiment.data)
    in_station = model_paths.exists(StationConfig, path, station.data)
    if in_experiment and in_station:
        wrong = "both the experiment and the station have this key"
        raise InputError([Problem(f"--set {key}", None, key, wrong, f"experiment.{key}=... or station.{key}=...")])
    if in_experiment:
        return set_key(experiment, key, value), station
    if in_station:
        return experiment, set_key(station, key, value)
    # A file with faults of its own may hide the key: they come first.
    parse(Experiment, experiment)
    parse(StationConfig, station)
    options = [*_keys(Experiment, experiment), *_keys(StationConfig, station)]
    raise InputError([_unknown(key, "neither the experiment nor the station has this key", options)])


def _set(model: type[BaseModel], document: Document, key: str, path: list[str], value: str) -> Document:
    if not model_paths.exists(model, path, document.data):
        parse(model, document)
        prefix = key.removesuffix(dotted(path))  # "experiment.", "station." or nothing
        options = [prefix + option for option in _keys(model, document)]
        kind = "experiment" if model is Experiment else "station"
        raise InputError([_unknown(key, f"the {kind} has no such key", options)])
    try:
        return set_key(document, dotted(path), value)
    except InputError as e:
        raise InputError([Problem(f"--set {key}", None, key, p.wrong, p.expected) for p in e.problems]) from None


def _keys(model: type[BaseModel], document: Document) -> list[str]:
    return [dotted(path) for path in model_paths.paths(model, document.data)]


def _unknown(key: str, wrong: str, options: list[str]) -> Problem:
    """The nearest option is one with the same last name, where there is one: `ramp` means `trial.ramp`."""
    last = _last(key)
    ending = last if any(_last(option) == last for option in options) else nearest(last, map(_last, options))
    same = [option for option in options if _last(option) == ending]
    close = nearest(key, same or options) or next(iter(same), "")
    return Problem(f"--set {key}", None, key, wrong, "an existing key, by its whole path", close)


def _last(key: str) -> str:
    return key.rpartition(".")[2]


# -- references ------------------------------------------------------------------------------------------------------


def _followed(
    document: Document, key: str, kind: str, folders: Sequence[Path], listed: Sequence[Path], default: str | None = None
) -> Document:
    """The file that ``key`` names; a file that is not found is a problem with the key, where the key stands.

    A path may also be relative to the folder of the file that names it.
    """
    name = document.data.get(key, default)
    if not isinstance(name, str):
        raise InputError([document.problem((key,), "names no file", f"the name of a {kind}, or a path")])
    try:
        path = locate(name, kind, [Path(document.file).parent, *folders], listed)
    except InputError as e:
        raise InputError(
            [document.problem((key,), f"{p.wrong}: {p.file}", p.expected, p.nearest) for p in e.problems]
        ) from None
    return read_yaml(path)


def _object(document: Document, key: str, reference: str | ObjectModel) -> ObjectModel:
    if isinstance(reference, ObjectModel):
        return reference
    return parse(ObjectModel, _followed(document, key, "object", [CATALOGUE], [CATALOGUE]))


def finger_kinds(station: StationConfig) -> tuple[str, ...]:
    """What the tactile fingers of a station are, each kind once."""
    return tuple(dict.fromkeys(d.sensor for d in station.devices.values() if isinstance(d, TactileConfig)))


def _sensor(document: Document, reference: str | SensorModel, station: StationConfig) -> SensorModel:
    """The sensor's file; ``auto`` is that of the station's fingers, a Soft Bubble's where it has none."""
    if isinstance(reference, SensorModel):
        return reference
    if reference == "auto":
        kinds = finger_kinds(station)
        if len(kinds) > 1:
            wrong = f"station {station.name} has fingers of several kinds"
            raise InputError([document.problem(("sensor",), wrong, one_of(kinds))])
        return load_sensor(kinds[0] if kinds else "soft_bubble")
    return parse(SensorModel, _followed(document, "sensor", "sensor", [SENSORS], [SENSORS]))


# -- what no file can know of itself -----------------------------------------------------------------------------------


def _world_problems(station: StationConfig, document: Document) -> list[Problem]:
    simulated = [name for name, device in station.devices.items() if device.backend == "sim"]
    if station.world is None:
        wrong = f"missing key: {', '.join(simulated)} are simulated"
        return [document.problem(("world",), wrong, "the simulated world")] if simulated else []
    profile, known = station.world.profile, profile_names()
    if profile in known or Path(profile).name != profile or profile.endswith((".yaml", ".yml")):
        try:
            load_profile(profile)
        except InputError as error:
            return list(error.problems)
        return []
    wrong = f"unknown world profile {profile!r}"
    return [document.problem(("world", "profile"), wrong, one_of(known), nearest(profile, known))]


def _tag_problems(resolved: Resolved) -> list[Problem]:
    """Two tags of one id could not be told apart."""
    owners: dict[int, str] = {}
    problems: list[Problem] = []
    station = resolved.station_document
    for i, mount in enumerate(resolved.station.table_tags):
        if mount.id in owners:
            problems.append(
                station.problem(
                    ("table_tags", i, "id"), f"tag {mount.id} stands twice", "an id of its own for each tag"
                )
            )
        owners[mount.id] = f"table_tags.{i}"
    for key, shape in (("grasped_object", resolved.grasped), ("extrinsic_object", resolved.extrinsic)):
        for tag in () if shape is None else shape.all_tags:
            if tag.id in owners:
                wrong = f"its tag has the id {tag.id}, as has {owners[tag.id]}"
                problems.append(resolved.experiment_document.problem((key,), wrong, "an id of its own for each tag"))
            owners[tag.id] = key
    return problems


def _grasp_problems(resolved: Resolved) -> list[Problem]:
    distance = float(resolved.grasped.polygon.signed_distance(resolved.grasp[:2]))
    if distance <= 0:
        return []
    wrong = f"the grasp centre lies {distance * 1e3:.1f} mm outside {resolved.grasped.name}"
    expected = "a point of the grasped object, in its frame (origin: the centroid)"
    return [resolved.experiment_document.problem(("grasp", "centre_mm"), wrong, expected)]
