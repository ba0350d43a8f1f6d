from dataclasses import replace as replace_sample

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from msgspec.structs import replace

from dsrc.data.sample import make_sample
from dsrc.models.inputs.batch import collate, pillars_of, scene_of
from dsrc.models.settings import ModelSettings
from dsrc.ops.grid import GridSpec
from dsrc.ops.pillars import voxelise
from sim.boxes import CLASSES, Boxes
from tests.dsrc.training.drive import frame
from tests.dsrc.training.runs import tiny

SETTINGS = ModelSettings(grid=GridSpec(range_m=(-3.2, -1.6, -3.0, 3.2, 1.6, 1.0)))

# Multiples of half a cell lie on borders of cells, some points lie beyond the range, some are no place at all.
clouds = arrays(
    np.float32,
    st.tuples(st.integers(0, 60), st.just(4)),
    elements=st.one_of(st.integers(-18, 18).map(lambda n: 0.2 * n), st.floats(-4.0, 4.0, width=32), st.just(np.nan)),
)
cropped = arrays(np.float32, st.tuples(st.integers(0, 60), st.just(4)), elements=st.floats(-3.5, 3.5, width=32))


@given(clouds, clouds, st.integers(1, 4), st.integers(1, 40))
def test_pillars_are_the_voxelisers(first: np.ndarray, second: np.ndarray, max_points: int, max_pillars: int) -> None:
    settings = replace(SETTINGS, max_points=max_points, max_pillars=max_pillars)
    found = pillars_of([first, second], settings)
    voxels = [
        voxelise(cloud, settings.grid.range_m, (0.4, 0.4, 4.0), max_points, max_pillars) for cloud in (first, second)
    ]
    expected = [cloud[v.order] for cloud, v in zip((first, second), voxels, strict=True)]
    assert np.array_equal(found.points.numpy(), np.concatenate(expected), equal_nan=True)
    assert found.count.tolist() == [n for v in voxels for n in v.count]
    coords = [[number, y, x] for number, v in enumerate(voxels) for _, y, x in v.coords_zyx.tolist()]
    assert found.coords.tolist() == coords
    assert found.pillar.tolist() == np.repeat(np.arange(len(coords)), found.count.numpy()).tolist()


@given(st.lists(cropped, min_size=1, max_size=2), st.sampled_from([0.4, 0.5, 4.0]))
def test_a_scenes_voxels_are_those_of_numpy(merged: list[np.ndarray], cell_z: float) -> None:
    scene = scene_of(merged, replace(SETTINGS, reconstruction_cell_z_m=cell_z))
    shape = (round(4.0 / cell_z), 8, 16)
    voxels, offsets = [], []
    for number, cloud in enumerate(merged):
        place = (cloud[:, 2::-1].astype(np.float64) - (-3.0, -1.6, -3.2)) / (cell_z, 0.4, 0.4)
        at = np.clip(place, 0, np.array(shape) - 1).astype(np.int64)
        cells, row, count = np.unique(at @ (128, 16, 1), return_inverse=True, return_counts=True)
        sums = np.stack([np.bincount(row, cloud[:, axis], len(cells)) for axis in range(3)], axis=1)
        zyx = np.stack(np.unravel_index(cells, shape), axis=1)
        centre = (zyx[:, ::-1] + 0.5) * (0.4, 0.4, cell_z) + (-3.2, -1.6, -3.0)
        voxels += [[number, *cell] for cell in zyx.tolist()]
        offsets.append((sums / count[:, None] - centre).astype(np.float32))
    assert scene.voxel.tolist() == voxels
    assert np.array_equal(scene.offset.numpy(), np.concatenate(offsets))


def test_a_voxels_offset_is_that_of_the_mean_of_its_points() -> None:
    cloud = np.array([[0.1, 0.1, 0.1, 1.0], [0.3, 0.1, 0.15, 1.0], [-1.0, -1.0, -1.0, 1.0]], np.float32)
    scene = scene_of([cloud], SETTINGS)
    assert scene.voxel.tolist() == [[0, 5, 1, 5], [0, 7, 4, 8]]
    np.testing.assert_allclose(scene.offset[1].numpy(), [0.0, -0.1, 0.125], atol=1e-6)


@given(clouds)
def test_a_point_that_is_nowhere_is_in_no_cell_beyond_the_grid(cloud: np.ndarray) -> None:
    z, y, x = scene_of([cloud], SETTINGS).voxel[:, 1:].numpy().T
    assert all(((0 <= at) & (at < size)).all() for at, size in ((z, 10), (y, 8), (x, 16)))


def test_a_persons_heading_is_not_learned_a_two_wheelers_is() -> None:
    settings = replace(tiny().model, users="vulnerable", sdd=False, pcp=False, rec=False)
    rows = [(3.0, 2.0, -1.0, 0.5, 0.6, 1.7, 2.0), (-6.1, 2.0, -1.0, 1.8, 0.65, 1.7, 1.0)]
    boxes = Boxes.from_array(np.array(rows), np.array([CLASSES.index("pedestrian"), CLASSES.index("bicycle")]))
    sample = replace_sample(make_sample(frame(0), 1000, settings.grid), boxes=boxes)
    targets = collate([sample], settings, training=True).targets
    angle = targets.regression[..., 6::7]
    person, bicycle = (targets.positive[..., anchor] for anchor in (0, 1))
    assert person.any() and bicycle.any()
    assert not angle[..., 0][person].any()
    np.testing.assert_allclose(angle[..., 1][bicycle], 1.0 - np.pi / 4, rtol=1e-6)
