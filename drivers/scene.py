"""What stands on the table: the bodies, the grasp, friction and where everything starts.

An experiment makes a `Scene` from the catalogue; the simulated world is reset with it. It carries numbers only (no
elasticity or friction model), so that the plant stays free of the planner's physics.
"""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict, Field

Vector2 = tuple[float, float]
Vector3 = tuple[float, float, float]


class Strict(BaseModel):
    """A frozen model that rejects unknown keys."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class TagMount(Strict):
    """An AprilTag (tag36h11) on a body: edge length of the black square [m], planar pose in the body's frame.

    ``height`` [m] is how far the tag's plane stands in front of the task plane, toward the viewer.
    """

    id: int = Field(ge=0, le=586)
    size: float = Field(gt=0)
    pose: Vector3 = (0.0, 0.0, 0.0)
    height: float = 0.0


class Body(Strict):
    """A rigid polygon: vertices (counter-clockwise, in the body frame, whose origin is the centroid) [m], mass [kg]."""

    name: str
    vertices: tuple[Vector2, ...]
    mass: float = Field(gt=0)
    tags: tuple[TagMount, ...] = ()


class Scene(Strict):
    """The initial state of a station. Friction coefficients by pair: ``go-ground``, ``go-eo``, ``eo-ground``.

    ``grasp`` is X_go_gocf, ``stiffness`` the finger's K in gocf [N/m, N, N·m/rad], ``start`` X_W_ee.
    """

    grasped: Body
    extrinsic: Body | None = None
    extrinsic_pose: Vector3 | None = None
    grasp: Vector3
    stiffness: tuple[Vector3, Vector3, Vector3]
    friction: dict[str, float]
    start: Vector3
    gravity: float = 9.81
