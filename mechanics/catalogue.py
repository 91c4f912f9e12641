"""The objects and tactile sensors that experiments name: data files, or any file or mapping of the same form."""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, model_validator

from mechanics.polygon import Polygon, PolygonError
from mechanics.readings import Array
from mechanics.yaml_input import Refusal, locate, parse, read_yaml

CATALOGUE = Path(__file__).parent / "catalogue"
SENSORS = Path(__file__).parent / "sensors"

Vector2 = tuple[float, float]
Row = tuple[float, float, float]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class TagModel(_Model):
    """An AprilTag (tag36h11) on an object. ``size_mm`` is the edge of its black square.

    ``position_mm`` and ``angle_deg`` are in the object's frame (origin: its centroid); ``height_mm`` is how far the
    tag stands in front of the task plane, toward the viewer.
    """

    id: int = Field(ge=0, le=586)
    size_mm: float = Field(gt=0, le=500, description="edge of the black square [mm]")
    position_mm: Vector2 = (0.0, 0.0)
    angle_deg: float = Field(default=0.0, ge=-360, le=360)
    height_mm: float = Field(default=10.0, ge=-500, le=500, description="in front of the task plane [mm]")


def _outline(vertices: tuple[Vector2, ...]) -> tuple[Vector2, ...]:
    try:
        polygon = Polygon(vertices)
    except PolygonError as e:
        expected = "a simple polygon: at least 3 corners, in order, each once, no edges that cross"
        at = e.vertices[:1] if len(vertices) > 2 else ()
        raise Refusal(str(e), expected, at=at) from None
    if not 1.0 <= polygon.bounding_radius <= 2000.0:
        wrong = f"the corners lie up to {polygon.bounding_radius:g} mm from the centroid"
        raise Refusal(wrong, "millimetres: an object between 1 mm and 2 m in radius")
    return vertices


def _each_once(tags: tuple[TagModel, ...]) -> tuple[TagModel, ...]:
    ids = [tag.id for tag in tags]
    for i, number in enumerate(ids):
        if number in ids[:i]:
            raise Refusal(f"tag {number} stands twice", "an id of its own for each tag", at=(i, "id"))
    return tags


class ObjectModel(_Model):
    """A rigid polygon of uniform density. ``vertices_mm`` may have any origin; the object's frame is the centroid's.

    ``friction`` is the Coulomb coefficient with the ground and with another object. It carries one ``tag``, or several
    ``tags``, all of which tell of its pose.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    vertices_mm: Annotated[tuple[Vector2, ...], AfterValidator(_outline)]
    mass: float = Field(gt=0, le=100, description="mass [kg]")
    friction: float = Field(default=0.33, gt=0, le=10, description="Coulomb coefficient")
    tag: TagModel | None = None
    tags: Annotated[tuple[TagModel, ...], AfterValidator(_each_once)] = Field(
        default=(), max_length=20, description="several tags, in place of `tag`"
    )

    @model_validator(mode="after")
    def _one_or_several(self) -> Self:
        if self.tag is not None and self.tags:
            raise Refusal("both `tag` and `tags`", "one of them", at=("tag",))
        return self

    @property
    def all_tags(self) -> tuple[TagModel, ...]:
        """Those that it carries."""
        return self.tags if self.tag is None else (self.tag,)

    @cached_property
    def polygon(self) -> Polygon:
        """The outline [m] in the object's frame: counter-clockwise, its centroid at the origin."""
        return Polygon(np.array(self.vertices_mm) * 1e-3).centred()

    def body(self, name: str) -> dict[str, Any]:
        """The object as the mapping a scene's body is made of: SI, in the object's frame."""
        tags = tuple(
            {
                "id": tag.id,
                "size": tag.size_mm * 1e-3,
                "pose": (*(v * 1e-3 for v in tag.position_mm), float(np.radians(tag.angle_deg))),
                "height": tag.height_mm * 1e-3,
            }
            for tag in self.all_tags
        )
        vertices = tuple((float(x), float(y)) for x, y in self.polygon.vertices)
        return {"name": name, "vertices": vertices, "mass": self.mass, "tags": tags}


def _stiffness(K: tuple[Row, Row, Row]) -> tuple[Row, Row, Row]:
    k = np.array(K)
    skew = np.abs(k - k.T)
    if skew.max() > 1e-6 * np.abs(k).max():
        i, j = sorted(int(n) for n in np.unravel_index(skew.argmax(), k.shape))
        wrong = f"not symmetric: row {i}, column {j} is {k[i, j]:g}, row {j}, column {i} is {k[j, i]:g} (from 0)"
        raise Refusal(wrong, "a symmetric, positive definite 3 × 3 matrix", at=(i,))
    eigenvalues = np.linalg.eigvalsh(k)
    if eigenvalues[0] <= 1e-12 * np.abs(eigenvalues).max():
        wrong = f"not positive definite: its smallest eigenvalue is {eigenvalues[0]:.6g}"
        raise Refusal(wrong, "a symmetric, positive definite 3 × 3 matrix (it is inverted)")
    return K


class SensorModel(_Model):
    """A compliant tactile finger pair: ``stiffness_printed`` as a publication prints it and its length scale.

    The printed matrix has one unit [N/m] throughout only if angles are scaled by a length ``rho_mm``:
    K = S K_printed S with S = diag(1, 1, rho). It belongs to the sensor, whatever is held.
    """

    name: str = Field(pattern=r"^[a-z][a-z0-9_]*$")
    stiffness_printed: Annotated[tuple[Row, Row, Row], AfterValidator(_stiffness)]
    rho_mm: float = Field(gt=0, le=10_000, description="length that angles are scaled by [mm]")

    @cached_property
    def stiffness(self) -> Array:
        """K (3, 3) in gocf, SI: N/m, N/rad (and N·m/m), N·m/rad."""
        scale = np.array([1.0, 1.0, self.rho_mm * 1e-3])
        K = scale[:, None] * np.array(self.stiffness_printed) * scale
        K.setflags(write=False)
        return K


def load_object(name: str, folders: Sequence[str | os.PathLike[str]] = ()) -> ObjectModel:
    """The object in a file: a path or a name, looked up in the current folder, ``folders`` and the catalogue.

    Raises InputError.
    """
    return parse(ObjectModel, read_yaml(locate(name, "object", [*folders, CATALOGUE], [CATALOGUE])))


def load_sensor(name: str, folders: Sequence[str | os.PathLike[str]] = ()) -> SensorModel:
    """The sensor in a file: a path or a name, looked up as in `load_object`. Raises InputError."""
    return parse(SensorModel, read_yaml(locate(name, "sensor", [*folders, SENSORS], [SENSORS])))
