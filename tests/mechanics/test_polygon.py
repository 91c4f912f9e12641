"""Polygons against shapely, polar integrals and closed forms."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from shapely.affinity import rotate, translate

from mechanics.polygon import Polygon, PolygonError

BOX = [[0.0, 0.0], [0.12, 0.0], [0.12, 0.06], [0.0, 0.06]]
U = [[0, 0], [3, 0], [3, 2], [2, 2], [2, 1], [1, 1], [1, 2], [0, 2]]


@st.composite
def stars(draw, min_size=3, max_size=12):
    """Star-shaped polygons, hence simple by construction: strictly increasing angles around an interior point."""
    n = draw(st.integers(min_size, max_size))
    gaps = np.array([draw(st.floats(0.3, 1.0)) for _ in range(n)])
    angles = draw(st.floats(-3, 3)) + 2 * np.pi * np.cumsum(gaps) / gaps.sum()
    assume((2 * np.pi * gaps / gaps.sum()).max() < 0.95 * np.pi)
    radii = np.array([draw(st.floats(0.02, 0.1)) for _ in range(n)])
    at = np.array([draw(st.floats(-0.2, 0.2)), draw(st.floats(-0.2, 0.2))])
    return at + radii[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)


poses = st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-7, 7))


@settings(deadline=None)
@given(stars())
def test_area_and_centroid_agree_with_shapely(v):
    polygon, reference = Polygon(v), shapely.Polygon(v)
    assert polygon.area == pytest.approx(reference.area, rel=1e-12)
    np.testing.assert_allclose(polygon.centroid, [reference.centroid.x, reference.centroid.y], atol=1e-14)


@settings(deadline=None)
@given(stars())
def test_inertia_is_the_sum_over_triangles_by_the_parallel_axis_theorem(v):
    polygon = Polygon(v)
    total = 0.0
    for triangle in shapely.get_parts(shapely.constrained_delaunay_triangles(shapely.Polygon(v))):
        a, b, c = shapely.get_coordinates(triangle)[:3]
        sides = ((a - b) ** 2).sum() + ((b - c) ** 2).sum() + ((c - a) ** 2).sum()
        centre = (a + b + c) / 3
        total += triangle.area * (sides / 36 + ((centre - polygon.centroid) ** 2).sum())
    assert polygon.inertia(0.7) == pytest.approx(0.7 * total / polygon.area, rel=1e-9)


@pytest.mark.parametrize("n", [3, 4, 5, 7, 60])
def test_regular_polygon_has_the_textbook_radius_of_gyration(n):
    angles = np.arange(n) * 2 * np.pi / n
    polygon = Polygon(0.07 * np.stack([np.cos(angles), np.sin(angles)], axis=1))
    # I/m = R²/2 · (1 − (2/3) sin²(π/n)), about the centre
    assert polygon.radius_of_gyration == pytest.approx(0.07 * np.sqrt(0.5 * (1 - 2 / 3 * np.sin(np.pi / n) ** 2)))
    assert polygon.bounding_radius == pytest.approx(0.07)


def test_rectangle_has_the_textbook_inertia():
    assert Polygon(BOX).inertia(0.5) == pytest.approx(0.5 * (0.12**2 + 0.06**2) / 12)


def test_mass_properties_survive_an_origin_that_is_a_kilometre_away():
    far = Polygon(np.array(BOX) + np.array([1e3, -1e3]))
    assert far.radius_of_gyration == pytest.approx(Polygon(BOX).radius_of_gyration, rel=1e-9)
    np.testing.assert_allclose(far.centroid, [1e3 + 0.06, -1e3 + 0.03], rtol=0, atol=1e-9)


@settings(deadline=None)
@given(stars())
def test_clockwise_input_is_reversed(v):
    assert Polygon(v[::-1]) == Polygon(v)
    assert shapely.is_ccw(shapely.linearrings(Polygon(v[::-1]).vertices))


@settings(deadline=None)
@given(stars(), poses)
def test_a_rigid_motion_keeps_shape_and_agrees_with_shapely(v, pose):
    moved = Polygon(v).transformed(pose)
    reference = translate(rotate(shapely.Polygon(v), pose[2], origin=(0, 0), use_radians=True), *pose[:2])
    np.testing.assert_allclose(moved.vertices, shapely.get_coordinates(reference)[:-1], atol=1e-12)
    assert moved.radius_of_gyration == pytest.approx(Polygon(v).radius_of_gyration, rel=1e-9)


@settings(deadline=None)
@given(stars())
def test_centred_has_its_centroid_at_the_origin(v):
    np.testing.assert_allclose(Polygon(v).centred().centroid, 0, atol=1e-15)


@settings(deadline=None)
@given(stars(), st.lists(st.tuples(st.floats(-0.4, 0.4), st.floats(-0.4, 0.4)), min_size=1, max_size=8))
def test_signed_distance_agrees_with_shapely(v, points):
    distance = Polygon(v).signed_distance(points)
    reference = shapely.Polygon(v)
    for d, p in zip(distance, points, strict=True):
        expected = reference.exterior.distance(shapely.Point(p))
        assert abs(d) == pytest.approx(expected, abs=1e-12)
        if expected > 1e-9:
            assert (d < 0) == reference.contains(shapely.Point(p))


def test_signed_distance_is_right_where_a_ray_meets_vertices():
    diamond = Polygon([[1, 0], [0, 1], [-1, 0], [0, -1]])
    np.testing.assert_allclose(diamond.signed_distance([[-2, 0], [0, 0], [2, 0], [-2, 1], [-1, 0]])[[0, 2]], 1)
    assert diamond.signed_distance([0.0, 0.0]) == pytest.approx(-np.sqrt(0.5))
    assert diamond.signed_distance([-2.0, 1.0]) > 0
    assert diamond.signed_distance(np.zeros((4, 5, 2))).shape == (4, 5)


@settings(deadline=None)
@given(stars(), st.floats(0.003, 0.2))
def test_boundary_samples_lie_on_the_boundary_no_farther_apart_than_the_spacing(v, spacing):
    polygon = Polygon(v)
    points, _, faces, lengths = polygon.boundary(spacing)
    ring = shapely.LinearRing(polygon.vertices)
    assert max(ring.distance(shapely.Point(p)) for p in points) < 1e-12
    along = np.sort([ring.project(shapely.Point(p)) for p in points])
    assert np.diff(along, append=along[0] + ring.length).max() <= spacing + 1e-9 or len(points) == len(polygon)
    assert lengths.sum() == pytest.approx(ring.length)
    assert set(faces) == set(range(len(polygon)))


@settings(deadline=None)
@given(stars(), st.floats(0.003, 0.2))
def test_boundary_normals_point_out_and_obey_the_divergence_theorem(v, spacing):
    polygon = Polygon(v)
    points, normals, _, lengths = polygon.boundary(spacing)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1)
    np.testing.assert_allclose((normals * lengths[:, None]).sum(axis=0), 0, atol=1e-12)  # ∮ n ds = 0
    # ∮ x·n ds = 2 A; the midpoint rule is exact, x·n being constant along a face
    assert ((points * normals).sum(axis=1) * lengths).sum() == pytest.approx(2 * shapely.Polygon(v).area, rel=1e-9)


@settings(deadline=None)
@given(stars())
def test_convex_pieces_are_convex_disjoint_and_cover_the_polygon(v):
    polygon = Polygon(v)
    pieces = [shapely.Polygon(p) for p in polygon.convex_pieces()]
    for piece in pieces:
        assert piece.area == pytest.approx(piece.convex_hull.area, rel=1e-9)
        assert shapely.is_ccw(piece.exterior)
    assert sum(p.area for p in pieces) == pytest.approx(polygon.area, rel=1e-12)
    union = shapely.union_all(pieces, grid_size=1e-12)
    assert union.symmetric_difference(shapely.Polygon(v)).area < 1e-9 * polygon.area
    reflex = sum(not _convex_corner(polygon.vertices, i) for i in range(len(polygon)))
    assert len(pieces) <= 2 * reflex + 1  # Hertel–Mehlhorn's bound


def _convex_corner(v, i):
    a, b = v[i] - v[i - 1], v[(i + 1) % len(v)] - v[i]
    return a[0] * b[1] - a[1] * b[0] > -1e-12


def test_known_shapes_split_into_few_pieces():
    assert len(Polygon(BOX).convex_pieces()) == 1
    assert len(Polygon([[0, 0], [2, 0], [2, 1], [1, 1], [1, 2], [0, 2]]).convex_pieces()) <= 3
    assert len(Polygon(U).convex_pieces()) == 3


def test_straight_corners_do_not_disturb_the_pieces():
    v = [[0, 0], [1, 0], [2, 0], [3, 0], [3, 2], [2, 2], [2, 1], [1.5, 1], [1, 1], [1, 2], [0, 2], [0, 1]]
    pieces = Polygon(v).convex_pieces()
    assert len(pieces) == 3
    assert sum(shapely.Polygon(p).area for p in pieces) == pytest.approx(5)


def test_convexity_of_known_shapes():
    assert Polygon(BOX).is_convex
    assert Polygon([[0, 0], [0.5, 0], [1, 0], [1, 1], [0, 1]]).is_convex
    assert not Polygon(U).is_convex


@settings(deadline=None)
@given(stars(), st.floats(-7, 7))
def test_lowest_vertices_are_those_of_the_turned_polygon(v, theta):
    polygon = Polygon(v)
    height = shapely.get_coordinates(rotate(shapely.Polygon(polygon.vertices), theta, (0, 0), True))[:-1, 1]
    found = polygon.lowest_vertices(theta, 1e-6)
    assert int(height.argmin()) in found
    assert all(height[i] <= height.min() + 1.1e-6 for i in found)


def test_a_flat_face_has_two_lowest_vertices_and_a_tilted_box_one():
    box = Polygon(BOX)
    assert box.lowest_vertices() == (0, 1)
    assert box.lowest_vertices(np.radians(15)) == (0,)
    assert box.lowest_vertices(np.radians(-15)) == (1,)


def test_vertices_cannot_be_changed_behind_the_polygons_back():
    source = np.array(BOX)
    polygon = Polygon(source)
    source[0] = 9
    assert polygon.vertices[0, 0] == 0
    with pytest.raises(ValueError, match="read-only"):
        polygon.vertices[0] = 1


@pytest.mark.parametrize(
    ("vertices", "says", "at"),
    [
        ([[0, 0], [1, 0]], "at least 3", ()),
        ([[0, 0, 0]] * 4, r"\(N, 2\)", ()),
        ("abc", "list of points", ()),
        ([[0, 0], [1], [2, 2]], "list of points", ()),
        ([[0, 0], [1, 0], [np.nan, 1]], "vertex 2 is not finite", (2,)),
        ([[0, 0], [1, 0], [1, 0], [0, 1]], "vertices 1 and 2 coincide", (1, 2)),
        ([[0, 0], [1, 0], [0, 1], [0, 0]], "vertices 3 and 0 coincide", (3, 0)),
        ([[0, 0], [1, 1], [1, 0], [0, 1]], "edge 0–1 crosses edge 2–3", (0, 1, 2, 3)),
        ([[0, 0], [4, 0], [4, 2], [2, 0], [0, 2]], "edge 0–1 crosses edge 2–3", (0, 1, 2, 3)),
        ([[0, 0], [3, 0], [1, 0], [1, 1]], "edge 0–1 folds back on edge 1–2", (1, 0, 2)),
        ([[0, 0], [1, 1], [2, 2]], "folds back", (0, 2, 1)),
        ([[0, 0], [1, 1e-12], [2, 0], [1, 1e-10]], "folds back|no area", None),
    ],
)
def test_bad_points_are_refused_by_name(vertices, says, at):
    with pytest.raises(PolygonError, match=says) as e:
        Polygon(vertices)
    if at is not None:
        assert set(e.value.vertices) == set(at)


@settings(deadline=None)
@given(stars(min_size=6), st.data())
def test_exchanging_two_vertices_is_refused_exactly_when_shapely_calls_it_invalid(v, data):
    i, j = data.draw(st.integers(0, len(v) - 1)), data.draw(st.integers(0, len(v) - 1))
    v[[i, j]] = v[[j, i]]
    if shapely.Polygon(v).is_valid:
        Polygon(v)
    else:
        with pytest.raises(PolygonError):
            Polygon(v)
