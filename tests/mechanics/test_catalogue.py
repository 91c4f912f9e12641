"""The shipped objects and sensors against the paper, and files of a user's own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ruamel.yaml import YAML
from shapely.geometry import Polygon as Shape
from shapely.geometry import box

from mechanics.catalogue import CATALOGUE, SENSORS, load_object, load_sensor
from mechanics.yaml_input import InputError
from tests.recordings import DATA, recorded

OBJECTS = ["hbox", "tall_box", "z", "heptagon", "pentagon", "triangle"]

# The paper's Table 3: τ error / √(summary² − fx² − fy²) [mm]
RADIUS_OF_GYRATION_MM = {"tall_box": 44.8, "z": 46.6, "heptagon": 46.8, "pentagon": 42.2, "triangle": 36.7}

# The paper's K_bubbles and K_gelslim, as printed
PRINTED = {
    "soft_bubble": [[2208.96, -143.31, 399.86], [-143.31, 1875.92, -313.57], [399.86, -313.57, 1608.49]],
    "gelslim": [[5060.26, -1261.90, -158.71], [-1261.90, 9998.16, 334.56], [-158.71, 334.56, 37.6311]],
}


def test_the_catalogue_ships_the_objects_and_sensors_of_the_paper():
    assert {p.stem for p in CATALOGUE.glob("*.yaml")} == set(OBJECTS)
    assert {p.stem for p in SENSORS.glob("*.yaml")} == set(PRINTED)


@pytest.mark.parametrize(("name", "rho_mm"), list(RADIUS_OF_GYRATION_MM.items()))
def test_radius_of_gyration_is_the_papers_to_a_tenth_of_a_millimetre(name, rho_mm):
    assert load_object(name).polygon.radius_of_gyration * 1e3 == pytest.approx(rho_mm, abs=0.1)


@recorded("../paper_tables.yaml")
def test_the_papers_tables_say_the_same():
    paper = YAML(typ="safe", pure=True).load((DATA / "../paper_tables.yaml").read_text())
    assert paper["pivoting"]["radius_of_gyration_mm"] == RADIUS_OF_GYRATION_MM
    assert paper["stiffness"] == PRINTED


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object_is_named_as_its_file_and_centred(name):
    shape = load_object(name)
    assert shape.name == name
    assert shape.friction == 0.33
    np.testing.assert_allclose(shape.polygon.centroid, 0, atol=1e-12)
    np.testing.assert_allclose(np.array(shape.vertices_mm).mean(axis=0), 0, atol=1e-3 if name != "z" else 10)


@pytest.mark.parametrize(("name", "sides"), [("triangle", 3), ("pentagon", 5), ("heptagon", 7)])
def test_regular_polygons_stand_on_a_side_with_the_apex_up(name, sides):
    polygon = load_object(name).polygon
    radii = np.linalg.norm(polygon.vertices, axis=1)
    assert len(polygon) == sides
    np.testing.assert_allclose(radii, radii.mean(), atol=1e-6)
    assert len(polygon.lowest_vertices(tolerance=1e-6)) == 2
    np.testing.assert_allclose(polygon.vertices[polygon.vertices[:, 1].argmax()], [0, radii.mean()], atol=1e-6)


@pytest.mark.parametrize(("name", "mass"), list(zip(OBJECTS, [0.5, 0.1, 0.1, 0.2, 0.15, 0.15], strict=True)))
def test_masses_are_those_of_the_well_posed_tasks(name, mass):
    assert load_object(name).mass == mass


@pytest.mark.parametrize("name", OBJECTS)
def test_the_tag_fits_on_the_object_with_its_white_border(name):
    shape = load_object(name)
    tag = shape.tag
    assert tag is not None
    half = tag.size_mm * 10 / 8 / 2  # eight cells of black square, one of white border all round
    x, y = tag.position_mm
    assert Shape(shape.polygon.vertices * 1e3).contains(box(x - half, y - half, x + half, y + half))


def test_tag_ids_are_unique():
    ids = [tag.id for name in OBJECTS if (tag := load_object(name).tag)]
    assert len(set(ids)) == len(OBJECTS)


def test_a_body_is_in_si():
    body = load_object("tall_box").body("go")
    assert body["name"] == "go"
    np.testing.assert_allclose(body["vertices"][0], [-0.025, -0.07345])
    [tag] = body["tags"]
    assert tag == {"id": 10, "size": pytest.approx(0.036), "pose": (0, pytest.approx(-0.04), 0), "height": 0.01}


@pytest.mark.parametrize(("name", "rho"), [("soft_bubble", 0.0448), ("gelslim", 1.0)])
def test_stiffness_is_the_printed_one_with_angles_scaled(name, rho):
    S = np.diag([1, 1, rho])
    K = load_sensor(name).stiffness
    np.testing.assert_allclose(K, S @ np.array(PRINTED[name]) @ S)
    np.linalg.cholesky(K)  # raises unless positive definite


def test_the_bubbles_rotational_stiffness_is_the_blueprints():
    assert load_sensor("soft_bubble").stiffness[2, 2] == pytest.approx(3.2, abs=0.05)  # N·m/rad


# -- a user's own files ------------------------------------------------------------------------------------------------


def write(folder: Path, text: str) -> str:
    path = folder / "mine.yaml"
    path.write_text(text)
    return str(path)


def refused(load, path: str):
    with pytest.raises(InputError) as e:
        load(path)
    assert len(e.value.problems) == 1, str(e.value)
    assert e.value.problems[0].file == path
    assert e.value.problems[0].expected
    return e.value.problems[0]


def test_a_polygon_of_the_users_own_is_loaded_and_centred(tmp_path):
    path = write(tmp_path, "name: wedge\nvertices_mm: [[0, 0], [0, 60], [90, 0]]\nmass: 0.2\n")
    wedge = load_object(path)
    assert wedge.polygon.area == pytest.approx(0.5 * 0.09 * 0.06)
    right_angle = wedge.polygon.vertices[np.abs(wedge.polygon.vertices - [-0.03, -0.02]).sum(axis=1).argmin()]
    np.testing.assert_allclose(right_angle, [-0.03, -0.02])  # a third of each leg from the right angle


def test_a_self_intersecting_polygon_is_refused_at_its_vertex_naming_both_edges(tmp_path):
    text = "name: bow\nmass: 1\nvertices_mm:\n- [0, 0]\n- [50, 50]\n- [50, 0]\n- [0, 50]\n"
    found = refused(load_object, write(tmp_path, text))
    assert (found.line, found.key) == (4, "vertices_mm.0")
    assert "edge 0–1 crosses edge 2–3" in found.wrong


def test_two_vertices_are_no_polygon(tmp_path):
    found = refused(load_object, write(tmp_path, "name: a\nmass: 1\nvertices_mm: [[0, 0], [1, 0]]\n"))
    assert (found.line, found.key) == (3, "vertices_mm")
    assert "at least 3" in found.expected


def test_vertices_in_metres_are_noticed(tmp_path):
    text = "name: a\nmass: 1\nvertices_mm: [[0, 0], [0.05, 0], [0.05, 0.05]]\n"
    assert "millimetres" in refused(load_object, write(tmp_path, text)).expected


@pytest.mark.parametrize("mass", ["-0.1", "0", "heavy", "'1'", "true", ".nan"])
def test_a_mass_that_is_no_positive_number_is_refused_at_its_line(tmp_path, mass):
    text = f"name: a\nvertices_mm: [[0, 0], [50, 0], [0, 50]]\nmass: {mass}\n"
    assert refused(load_object, write(tmp_path, text)).line == 3


def test_a_misspelt_key_is_refused_with_the_nearest(tmp_path):
    text = "name: a\nvertices_mm: [[0, 0], [50, 0], [0, 50]]\nmass: 1\nfricton: 0.3\n"
    found = refused(load_object, write(tmp_path, text))
    assert (found.line, found.key, found.nearest) == (4, "fricton", "friction")


def test_a_stiffness_that_is_not_positive_definite_names_its_smallest_eigenvalue(tmp_path):
    # [[1, 2], [2, 1]] has the eigenvalues 3 and −1
    text = "name: a\nrho_mm: 40\nstiffness_printed: [[1, 2, 0], [2, 1, 0], [0, 0, 5]]\n"
    found = refused(load_sensor, write(tmp_path, text))
    assert (found.line, found.key) == (3, "stiffness_printed")
    assert "smallest eigenvalue is -1" in found.wrong
    assert "positive definite" in found.expected


def test_a_singular_stiffness_is_refused(tmp_path):
    text = "name: a\nrho_mm: 40\nstiffness_printed: [[1, 1, 0], [1, 1, 0], [0, 0, 5]]\n"
    assert "positive definite" in refused(load_sensor, write(tmp_path, text)).wrong


def test_a_stiffness_that_is_not_symmetric_names_the_entries(tmp_path):
    text = "name: a\nrho_mm: 40\nstiffness_printed:\n- [10, 2, 0]\n- [3, 10, 0]\n- [0, 0, 5]\n"
    found = refused(load_sensor, write(tmp_path, text))
    assert (found.line, found.key) == (4, "stiffness_printed.0")
    assert "row 0, column 1 is 2, row 1, column 0 is 3" in found.wrong
