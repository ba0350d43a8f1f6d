"""Which frames are trained on, in which order, and how fast the learning rate moves."""

from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from dsrc.models.inputs.batch import collate
from dsrc.training.datamodule import DetectionData, EpochSampler
from dsrc.training.module import RateCurve
from dsrc.training.recipes import RECIPES, Augmentation, debug, of_method
from tests.dsrc.training.drive import write_drive


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("data"), 5) / "made_up"


def test_held_out_frames_are_the_last_of_a_drive_and_are_not_trained_on(data: Path) -> None:
    recipe = replace(debug(), validation_share=0.4)
    loaders = DetectionData(recipe, recipe.model, [data], None, seed=0)
    assert [f.position for f in loaders.training.frames] == [0, 1, 2]
    assert [f.position for f in loaders.validation.frames] == [3, 4]
    assert len(loaders.train_dataloader()) == 1


def test_the_order_depends_on_seed_and_epoch_alone() -> None:
    one, two = EpochSampler(50, seed=1), EpochSampler(50, seed=1)
    for sampler in (one, two):
        sampler.set_epoch(3)
    assert list(one) == list(two)
    assert sorted(number for _, number in one) == list(range(50))
    two.set_epoch(4)
    assert [n for _, n in one] != [n for _, n in two]


def test_a_short_epoch_draws_other_frames_each_time_and_none_twice() -> None:
    sampler, drawn = EpochSampler(50, seed=1, limit=20), []
    for epoch in range(30):
        sampler.set_epoch(epoch)
        drawn.append([number for _, number in sampler])
        assert len(set(drawn[-1])) == len(drawn[-1]) == len(sampler) == 20
    assert drawn[0] != drawn[1]
    assert set().union(*drawn) == set(range(50))
    assert len(EpochSampler(5, seed=1, limit=20)) == 5


def test_a_short_epoch_has_its_number_of_steps(data: Path) -> None:
    recipe = replace(debug(), epoch_frames=3, batch_size=2)
    assert len(DetectionData(recipe, recipe.model, [data], None, seed=0).train_dataloader()) == 1
    alone = replace(debug(), epoch_frames=1, batch_size=2)
    assert len(DetectionData(alone, alone.model, [data], None, seed=0).train_dataloader()) == 1


def test_a_training_sample_depends_on_seed_epoch_and_number_alone(data: Path) -> None:
    recipe = replace(debug(), augmentation=RECIPES["small"]().augmentation)
    sets = [DetectionData(recipe, recipe.model, [data], None, seed=s).training for s in (1, 1, 2)]
    clouds = [s[(2, 1)].clouds[0] for s in sets]
    np.testing.assert_array_equal(clouds[0], clouds[1])
    assert clouds[0].shape != clouds[2].shape or not np.array_equal(clouds[0], clouds[2])


def test_a_plain_network_of_single_vehicles_reads_the_sample_that_others_leave_of_the_team_s(data: Path) -> None:
    recipe = of_method(debug(), "no-collaboration")
    alone = replace(recipe, augmentation=replace(recipe.augmentation, alone=1.0))
    settings = alone.settings("plain")
    one = DetectionData(alone, settings, [data], None, seed=1).training[(0, 1)]
    team = DetectionData(alone, replace(settings, role="teacher"), [data], None, seed=1).training[(0, 1)]
    assert len(one.other_clouds) == 0 < len(team.other_clouds)
    assert one.agent_ids == team.agent_ids and np.array_equal(one.clouds[0], team.clouds[0])
    assert np.array_equal(one.boxes.object_id, team.boxes.object_id)


def test_boxes_of_few_points_are_no_ground_truth_of_a_training_that_asks_for_more(data: Path) -> None:
    """An agent of this drive has 120 points on each road user that it sees."""

    def boxes(min_points: int) -> int:
        recipe = replace(debug(), labels=replace(debug().labels, min_points=min_points))
        training = DetectionData(recipe, recipe.model, [data], None, seed=1).training
        return sum(len(training[(0, number)].boxes) for number in range(len(training)))

    assert boxes(1) == boxes(120) > 0 == boxes(121)


def test_the_rate_rises_to_its_peak_and_falls_to_almost_nothing() -> None:
    curve = RateCurve(debug(), steps=100)
    rates = [curve(step) for step in range(101)]
    assert max(rates) == curve(10) == pytest.approx(1.0)
    assert rates[0] < 0.05
    assert rates[100] < 1e-3
    assert (np.diff(rates[10:]) < 0).all()


@pytest.mark.parametrize("name", RECIPES)
def test_every_recipe_has_a_grid_that_its_three_scales_divide(name: str) -> None:
    recipe = RECIPES[name]()
    assert recipe.name == name
    assert recipe.model.grid.width % 8 == recipe.model.grid.height % 8 == 0
    assert recipe.model.reconstruction_bins % 2 == 0


def test_samples_and_batches_of_heights_above_the_ground_stand_on_it(data: Path) -> None:
    """LiDARs of the drive stand 1.8 m above a plane, which lies 1.9 m below the origin once it is level."""
    recipe = replace(debug(), validation_share=0.4, augmentation=Augmentation(height_m=0.0))
    recipe = replace(recipe, model=replace(recipe.model, height="ground"))
    loaders = DetectionData(recipe, recipe.settings("plain"), [data], None, seed=0)
    sample = loaders.training[0, 1]
    seen = collate([loaders.validation[0]], recipe.settings("plain"), training=False)
    assert len(sample.grounds) == len(sample.clouds)
    for boxes in (sample.boxes, seen.boxes[0]):
        assert len(boxes) > 2
        assert np.median(boxes.center[:, 2] - boxes.size[:, 2] / 2) == pytest.approx(-1.9, abs=0.06)
    assert seen.student is not None
    for z in (sample.clouds[0][:, 2], seen.student.points[:, 2].numpy()):
        assert np.median(z) == pytest.approx(-1.9, abs=0.06)
