"""Crowns, hedges and shrubs: a share of the beams passes, the others return scattered in depth."""

import numpy as np
import pytest
import shapely
from embreex import rtcore_scene
from embreex.mesh_construction import TriangleMesh

from sim.mesh.materials import material_index
from sim.mesh.solids import MeshPart, join
from sim.world.beside.foliage import leaves
from sim.world.beside.plants import HEDGE_TIPS_M, hedge, shrub
from sim.world.beside.trees import SPECIES, pruned, tree
from sim.world.roads.streets import NOTHING, Streets
from sim.world.roads.terrain import level_land

WINDOW = (-50.0, -50.0, 50.0, 50.0)
STREETS = Streets(WINDOW, WINDOW, (), NOTHING, NOTHING, NOTHING, level_land(WINDOW, 0.0))


def cast(part: MeshPart, y: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Return (N,) way along x of level rays from x = -30, inf where they meet nothing."""
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, part.vertices.astype(np.float32), part.faces.astype(np.int32))
    start = np.column_stack([np.full(len(y), -30.0), y, z]).astype(np.float32)
    way = np.tile(np.array([1.0, 0.0, 0.0], np.float32), (len(y), 1))
    hits = scene.run(start, way, output=1)
    return np.where(hits["primID"] >= 0, hits["tfar"], np.inf)


def of_material(part: MeshPart, name: str) -> MeshPart:
    chosen = part.material == material_index(name)
    return MeshPart(part.vertices, part.faces[chosen], part.material[chosen])


def test_rays_pass_leaves_as_often_as_their_density_says() -> None:
    rng = np.random.default_rng(0)
    density, deep, area = 1.0, 2.0, 0.01
    count = round(density * deep * 36.0 / area)
    part = leaves(rng, rng.uniform([0.0, -3.0, -3.0], [deep, 3.0, 3.0], (count, 3)), area)
    y, z = rng.uniform(-2.0, 2.0, (2, 4000))
    passed = np.isinf(cast(part, y, z)).mean()
    assert passed == pytest.approx(np.exp(-0.5 * density * deep), abs=0.03)


@pytest.mark.parametrize("name", sorted(SPECIES))
def test_beams_pass_and_graze_a_crown(name: str) -> None:
    rng = np.random.default_rng(3)
    passed, depth = [], []
    for _ in range(8):
        one = tree(rng, SPECIES[name])
        crown = of_material(one.part, "leaves")
        high = crown.vertices[:, 2].max()
        radius = one.reach_m - 0.3
        middle, half = 0.5 * (one.foot_m + high), 0.5 * (high - one.foot_m)
        y, z = rng.uniform(-1.0, 1.0, (2, 3000))
        inside = y**2 + z**2 < 0.5**2
        distance = cast(crown, radius * y[inside], middle + half * z[inside])
        passed.append(np.isinf(distance).mean())
        depth.append(np.std(distance[np.isfinite(distance)]))
    assert 0.01 < np.mean(passed) < 0.55
    assert np.mean(depth) > 0.25


def test_a_crown_stays_within_its_reach_and_above_its_foot() -> None:
    rng = np.random.default_rng(1)
    for species in SPECIES.values():
        for fine in (True, False):
            one = tree(rng, species, fine=fine)
            crown = of_material(one.part, "leaves")
            corners = crown.vertices[np.unique(crown.faces)]
            assert np.hypot(*corners[:, :2].T).max() <= one.reach_m + 1e-9
            assert corners[:, 2].min() >= one.foot_m - 1e-9
            cut = of_material(pruned(one, 4.8).part, "leaves")
            assert cut.vertices[np.unique(cut.faces), 2].min() >= min(4.8, one.foot_m) - 1e-9
            assert pruned(one, 4.8).foot_m >= 4.8 or one.foot_m >= 4.8


def test_a_coarse_tree_has_the_leaf_area_of_a_fine_one() -> None:
    def area(fine: bool) -> float:
        rng = np.random.default_rng(5)
        parts = [of_material(tree(rng, SPECIES["lime"], fine=fine).part, "leaves") for _ in range(20)]
        whole = join(parts)
        corners = whole.vertices[whole.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        return float(0.5 * np.linalg.norm(cross, axis=1).sum())

    assert area(False) == pytest.approx(area(True), rel=0.3)


def test_a_hedge_is_dense_and_rough() -> None:
    rng = np.random.default_rng(2)
    line = shapely.LineString([(0.0, -8.0), (0.0, 8.0)])
    part = join(hedge(rng, line, 1.5, 0.8, STREETS))
    distance = cast(part, rng.uniform(-7.0, 7.0, 3000), rng.uniform(0.1, 1.1, 3000))
    assert np.isinf(distance).mean() < 0.02
    assert 0.06 < np.std(distance) < 0.3
    assert np.abs(part.vertices[:, 0]).max() < 0.4 + HEDGE_TIPS_M


def test_beams_pass_the_rim_of_a_shrub_and_none_its_middle() -> None:
    rng = np.random.default_rng(4)
    part = shrub(rng, 20)
    y, z = rng.uniform(-1.0, 1.0, 4000), rng.uniform(0.0, 1.0, 4000)
    distance = cast(part, y, z)
    assert 0.1 < np.isinf(distance).mean() < 0.7
    assert np.isinf(distance[np.hypot(y, 2.0 * z - 0.85) < 0.2]).mean() < 0.05
    assert np.std(distance[np.isfinite(distance)]) > 0.15
