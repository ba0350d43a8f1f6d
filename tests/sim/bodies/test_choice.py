import subprocess
import sys

import numpy as np
import pytest
import trimesh

from sim.bodies.choice import MODELS, body_mesh, generic_models_for, models_for
from sim.boxes import CLASSES
from sim.errors import SettingsError
from sim.mesh.materials import MATERIALS, material_index

SIZE = {
    "car": (4.71, 1.83, 1.47), "van": (5.95, 2.05, 2.6), "truck": (10.2, 2.55, 3.8), "bus": (12.0, 2.55, 3.15),
    "motorcycle": (2.2, 0.85, 1.65), "bicycle": (1.75, 0.65, 1.75), "pedestrian": (0.6, 0.58, 1.72),
}  # fmt: skip
GENERIC = [(name, model) for name in ("car", "van") for model in generic_models_for(name)]
ALL = [(name, model) for name, models in MODELS.items() for model in models] + GENERIC
OWN = [(name, model) for name, model in ALL if not model.startswith("car-")]


def test_every_class_has_a_model() -> None:
    assert set(MODELS) == set(CLASSES) and all(models_for(name) for name in CLASSES)
    assert len({model for _, model in ALL}) == len(ALL)


@pytest.mark.parametrize(("name", "model"), ALL)
def test_a_mesh_is_as_large_as_its_box(name: str, model: str) -> None:
    mesh = body_mesh(model, SIZE[name])
    length, width, height = SIZE[name]
    for vertices in (mesh.vertices, mesh.vertices.astype(np.float32)):
        vertices = np.asarray(vertices, np.float64)
        assert np.allclose(vertices.min(axis=0), [-length / 2, -width / 2, 0.0], rtol=0, atol=1e-6)
        assert np.allclose(vertices.max(axis=0), [length / 2, width / 2, height], rtol=0, atol=1e-6)


@pytest.mark.parametrize(("name", "model"), ALL)
def test_every_face_has_a_known_material(name: str, model: str) -> None:
    mesh = body_mesh(model, SIZE[name])
    material = mesh.face_attributes["material"]
    assert material.dtype == np.uint8 and material.shape == (len(mesh.faces),)
    assert material.max() < len(MATERIALS) and len(set(material)) >= 3


@pytest.mark.parametrize(("name", "model"), OWN)
def test_own_meshes_are_closed_parts_that_face_outwards(name: str, model: str) -> None:
    mesh = body_mesh(model, SIZE[name])
    parts = trimesh.graph.connected_components(mesh.edges, nodes=np.arange(len(mesh.vertices)))
    assert len(parts) > 5
    for rows in parts:
        used = np.isin(mesh.faces[:, 0], rows)
        part = trimesh.Trimesh(mesh.vertices, mesh.faces[used], process=False)
        assert part.is_watertight and part.volume > 0


@pytest.mark.parametrize("name", ["car", "van", "truck", "bus", "motorcycle"])
def test_head_lamps_are_in_front_and_tail_lamps_behind(name: str) -> None:
    for model in {*models_for(name), *generic_models_for(name)}:
        mesh = body_mesh(model, SIZE[name])
        x = mesh.triangles_center[:, 0]
        material = mesh.face_attributes["material"]
        assert x[material == material_index("head_lamp")].min() > 0.25 * SIZE[name][0]
        assert x[material == material_index("tail_lamp")].max() < -0.25 * SIZE[name][0]


def test_a_body_stands_on_wheels_and_looks_the_same_from_left_and_right() -> None:
    mesh = body_mesh("car-normal-citrus:red", SIZE["car"])
    tyres = mesh.triangles_center[mesh.face_attributes["material"] == material_index("tyre")]
    assert tyres[:, 2].min() < 0.05 and (tyres[:, 1] > 0).mean() == pytest.approx(0.5, abs=0.01)


def test_paint_is_a_variant_of_one_shape() -> None:
    red, blue = (body_mesh(f"car-minibus-citrus:{paint}", SIZE["van"]) for paint in ("red", "blue"))
    assert np.array_equal(red.vertices, blue.vertices)
    assert set(red.face_attributes["material"]) != set(blue.face_attributes["material"])


def test_plain_models_are_made_where_sumo_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sim.bodies.cars.sumo_home", lambda: pytest.fail("a file of SUMO was looked for"))
    for name in CLASSES:
        for model in generic_models_for(name):
            assert len(body_mesh.__wrapped__(model, SIZE[name]).faces) > 50


def test_a_mesh_is_made_once_for_each_model_and_size() -> None:
    assert body_mesh("truck:blue", SIZE["truck"]) is body_mesh("truck:blue", SIZE["truck"])


def test_unknown_names_and_sizes_are_told_in_one_line() -> None:
    with pytest.raises(SettingsError, match="did you mean 'bicycle'"):
        models_for("bycicle")
    with pytest.raises(SettingsError, match="did you mean 'truck:blue'"):
        body_mesh("truck:blu", SIZE["truck"])
    with pytest.raises(SettingsError, match="three lengths"):
        body_mesh("truck:blue", (4.0, float("nan"), 2.0))


def test_names_of_models_need_no_meshes() -> None:
    code = "import sys, sim.bodies.choice; sys.exit('trimesh' in sys.modules or 'shapely' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
