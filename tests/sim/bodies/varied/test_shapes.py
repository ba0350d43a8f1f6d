"""Bodies of worlds of version 2."""

import numpy as np
import pytest
import trimesh

from sim.bodies.choice import body_mesh, require_model
from sim.bodies.varied.looks import LOOKS
from sim.bodies.varied.shapes import is_varied
from sim.bodies.varied.types import VARIED
from sim.boxes import CLASSES
from sim.errors import SettingsError
from sim.mesh.materials import MATERIALS, material_index

MODELS = sorted(
    {
        f"{one.shape}/{variant}:" + "+".join(next(iter(shares)) for shares in LOOKS[one.looks])
        for one in VARIED.values()
        for variant, _ in one.variants
    }
)
"""A model of every shape and variant."""
MOST_TRIANGLES = 1_500
LEAST_SHAPES = {
    "car": 10, "van": 5, "truck": 6, "bus": 3, "motorcycle": 3, "bicycle": 3, "pedestrian": 5,
}  # fmt: skip
"""Outlines of each class, variants not counted."""


def size_of(model: str) -> tuple[float, float, float]:
    """Mean size of the first type that has a model."""
    shape, _, rest = model.partition("/")
    variant = rest.partition(":")[0]
    fitting = (one for one in VARIED.values() if one.shape == shape and variant in dict(one.variants))
    return next(fitting).kind.size


def cast(mesh: trimesh.Trimesh, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, list[str]]:
    """(N, 3) first points that rays meet, NaN without one, and their materials."""
    from sensors.raycast import Solid, open_engine
    from sensors.scan.scene import mesh_arrays

    vertices, faces, material = mesh_arrays(mesh, "body")
    solid = Solid(vertices.astype(np.float32), faces, material)
    reach = np.full(len(origins), 40.0, np.float32)
    hits = open_engine(None).cast(solid, origins.astype(np.float32), directions.astype(np.float32), reach)
    points = origins + hits.distance[:, None] * directions
    points[hits.face < 0] = np.nan
    return points, [MATERIALS[material[face]].name if face >= 0 else "" for face in hits.face]


@pytest.mark.parametrize("model", MODELS)
def test_a_mesh_is_as_large_as_its_box(model: str) -> None:
    length, width, height = size = size_of(model)
    vertices = np.asarray(body_mesh(model, size).vertices)
    np.testing.assert_allclose(vertices.min(axis=0), [-length / 2, -width / 2, 0.0], atol=1e-6)
    np.testing.assert_allclose(vertices.max(axis=0), [length / 2, width / 2, height], atol=1e-6)


@pytest.mark.parametrize("model", MODELS)
def test_a_shape_is_hardly_distorted_by_its_size(model: str) -> None:
    """The shape in its own proportions fits every type that has it, people as small as children included."""
    from sim.bodies.varied.shapes import varied_shape

    own = np.ptp(varied_shape(model).vertices, axis=0)
    ratio = np.array(size_of(model)) / own
    np.testing.assert_allclose(ratio / ratio.mean(), 1.0, atol=0.08)


@pytest.mark.parametrize("model", MODELS)
def test_meshes_are_light_and_made_of_closed_parts_that_face_outwards(model: str) -> None:
    mesh = body_mesh(model, size_of(model))
    assert 300 < len(mesh.faces) <= MOST_TRIANGLES
    material = mesh.face_attributes["material"]
    assert material.max() < len(MATERIALS) and len(set(material)) >= 3
    parts = trimesh.graph.connected_components(mesh.edges, nodes=np.arange(len(mesh.vertices)))
    assert len(parts) > 5
    part_of = np.zeros(len(mesh.vertices), int)
    for number, rows in enumerate(parts):
        part_of[rows] = number
    for number in range(len(parts)):
        faces = mesh.faces[part_of[mesh.faces[:, 0]] == number]
        part = trimesh.Trimesh(mesh.vertices, faces, process=False)
        assert part.is_watertight and part.volume > 0


@pytest.mark.parametrize("label", CLASSES)
def test_every_class_has_many_shapes(label: str) -> None:
    kinds = [one for one in VARIED.values() if one.kind.label == label]
    outlines = {(one.shape, variant) for one in kinds for variant, _ in one.variants}
    assert len({one.shape for one in kinds}) >= LEAST_SHAPES[label] and len(outlines) >= LEAST_SHAPES[label]


@pytest.mark.parametrize("model", [name for name in MODELS if size_of(name)[0] > 1.8 and "bike" not in name])
def test_lamps_and_plates_are_at_the_ends(model: str) -> None:
    if model.partition(":")[2].startswith("cloth"):
        pytest.skip("people on foot")
    mesh = body_mesh(model, size_of(model))
    x, material = mesh.triangles_center[:, 0], mesh.face_attributes["material"]
    assert x[material == material_index("head_lamp")].min() > 0.15 * size_of(model)[0]
    assert x[material == material_index("tail_lamp")].max() < -0.35 * size_of(model)[0]
    assert (material == material_index("plate")).any()


@pytest.mark.parametrize("shape", ["hatchback", "estate", "suv", "minibus", "large_van", "city_bus"])
def test_rays_through_open_windows_meet_the_inside(shape: str) -> None:
    """Rays from the side, from a little above as a sensor on a roof sees a car: seats, trim and the far wall."""
    model = next(
        name for name in MODELS if name.startswith(f"{shape}/") and "coated" not in name and "privacy" not in name
    )
    length, width, height = size = size_of(model)
    mesh = body_mesh(model, size)
    x, z = np.meshgrid(np.linspace(-0.45, 0.45, 120) * length, np.linspace(0.4, 0.95, 60) * height)
    way = np.array([0.0, -1.0, -0.12]) / np.hypot(1.0, 0.12)
    origins = np.column_stack([x.ravel(), np.full(x.size, 0.5 * width), z.ravel()]) - 10.0 * way
    points, materials = cast(mesh, origins, np.tile(way, (x.size, 1)))
    depth = 0.5 * width - points[:, 1]
    inside = {name for name, within in zip(materials, depth > 0.25, strict=True) if within}
    assert {"seat", "cabin"} <= inside
    share = (depth > 0.25).sum() / np.isfinite(depth).sum()
    assert 0.03 < share < 0.6 and np.nanmax(depth) > 0.8 * width


def test_dark_panes_send_nothing_back_but_squarely() -> None:
    size = size_of("suv/privacy:solid_white")
    for variant, behind in (("clear", True), ("privacy", False)):
        x, z = np.meshgrid(np.linspace(-1.6, -0.6, 40), np.linspace(1.22, 1.5, 20))
        origins = np.column_stack([x.ravel(), np.full(x.size, 20.0), z.ravel()])
        _, materials = cast(
            body_mesh(f"suv/{variant}:solid_white", size), origins, np.tile([0.0, -1.0, 0.0], (x.size, 1))
        )
        assert ("glass" in materials) is not behind and ("seat" in materials) is behind


def test_a_pick_up_has_an_open_bed() -> None:
    model = "pick_up/clear:solid_white"
    size = size_of(model)
    origins = np.array([[-0.3 * size[0], 0.0, 10.0], [0.0, 0.0, 10.0]])
    points, _ = cast(body_mesh(model, size), origins, np.tile([0.0, 0.0, -1.0], (2, 1)))
    assert points[0, 2] < 0.5 * size[2] and points[1, 2] > 0.9 * size[2]


def test_names_of_models_are_told_from_others() -> None:
    assert all(is_varied(name) for name in MODELS)
    for name in (
        "saloon:red",
        "saloon/clear:paint_red",
        "saloon/plain:solid_red",
        "/:",
        "walking/pram:cloth_red+cloth_black",
    ):
        assert not is_varied(name)
    with pytest.raises(SettingsError, match="unknown model 'saloon/clear:rust'"):
        require_model("saloon/clear:rust")
