"""Which weights a training ends with, and when it ends."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch
from msgspec.structs import replace

from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import load_detector
from dsrc.training.averaging import WeightSelection
from dsrc.training.train import train
from sim.errors import SettingsError
from tests.dsrc.training.drive import write_drive
from tests.dsrc.training.runs import Power, tiny


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("data"), 4)


class Run:
    """A training in which all weights of the detector are set to one number per step, and the precision is given."""

    def __init__(self, folder: Path, **choice: object) -> None:
        self.recipe = tiny(**choice)
        self.selection = WeightSelection(self.recipe, folder / "best.pt")
        self.module = SimpleNamespace(detector=Detector(self.recipe.model), device="cpu")
        self.trainer = SimpleNamespace(callback_metrics={}, current_epoch=-1, is_global_zero=True, should_stop=False)
        self.seen: list[float] = []
        self.set(0.0)
        self.selection.on_train_start(self.trainer, self.module)

    def set(self, value: float) -> None:
        for tensor in self.module.detector.parameters():
            torch.nn.init.constant_(tensor, value)

    @property
    def weight(self) -> float:
        return self.module.detector.reg_head.weight[0, 0, 0, 0].item()

    def step(self, value: float) -> None:
        self.set(value)
        self.selection.on_train_batch_end(self.trainer, self.module, None, None, 0)

    def validate(self, ap: float) -> None:
        self.trainer.current_epoch += 1
        self.selection.on_validation_start(self.trainer, self.module)
        self.seen.append(self.weight)
        self.trainer.callback_metrics = {f"val/ap_bev_{t}": torch.tensor(ap) for t in (30, 50, 70)}
        self.selection.on_validation_end(self.trainer, self.module)

    def final(self) -> float:
        self.selection.apply(self.module.detector)
        return self.weight


def test_a_training_ends_when_it_has_not_got_better_for_so_long(tmp_path: Path) -> None:
    run = Run(tmp_path, patience=2)
    for ap in (0.1, 0.3, 0.2, 0.4, 0.4):
        run.validate(ap)
        assert not run.trainer.should_stop
    run.validate(0.3)
    assert run.trainer.should_stop


def test_without_patience_a_training_goes_on(tmp_path: Path) -> None:
    run = Run(tmp_path)
    for ap in (0.5, 0.1, 0.1, 0.1):
        run.validate(ap)
    assert not run.trainer.should_stop


@pytest.mark.parametrize(("keep", "weight", "epoch", "ap"), [("best", 2.0, 1, 0.6), ("last", 3.0, 2, 0.5)])
def test_the_weights_that_are_asked_for_are_kept(
    tmp_path: Path, keep: str, weight: float, epoch: int, ap: float
) -> None:
    run = Run(tmp_path, keep=keep)
    for value, precision in ((1.0, 0.4), (2.0, 0.6), (3.0, 0.5)):
        run.step(value)
        run.validate(precision)
    assert run.final() == weight
    assert run.selection.epoch == epoch
    assert run.selection.metrics["val/ap_bev_50"] == pytest.approx(ap)


def test_the_average_is_what_is_validated_and_kept_and_the_training_goes_on_from_its_own_weights(
    tmp_path: Path,
) -> None:
    run = Run(tmp_path, ema=0.5)
    average = 0.0
    for step, value in enumerate((1.0, 2.0, 5.0)):
        run.step(value)
        average += max(0.5, 9 / (10 + step)) * (value - average)
        run.validate(0.5)
        assert run.weight == value
    assert run.seen[-1] == pytest.approx(average)
    assert run.final() == pytest.approx(average)


def test_an_average_over_a_thousand_steps_follows_in_the_first_ten(tmp_path: Path) -> None:
    run = Run(tmp_path, ema=0.999)
    for _ in range(10):
        run.step(1.0)
    assert run.final() > 0.99


def test_to_choose_there_must_be_something_to_choose_by(data: Path, tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"keep: expected frames that are not trained on, to choose by, found none"):
        train(tiny(keep="best"), data, tmp_path, "plain")
    with pytest.raises(SettingsError, match="patience: expected frames"):
        train(tiny(patience=2), data, tmp_path, "plain")


@pytest.mark.parametrize("choice", [{"keep": "best"}, {"patience": 3}, {}])
def test_what_chooses_the_weights_stays_the_same_in_a_run(
    data: Path, tmp_path: Path, choice: dict[str, object]
) -> None:
    recipe = tiny(epochs=2, **choice)
    run, unseen, others = tmp_path / "run", write_drive(tmp_path / "unseen", 2), write_drive(tmp_path / "others", 3)
    with pytest.raises(RuntimeError, match="power cut"):
        train(recipe, data, run, "plain", validate=unseen, callbacks=[Power(1)])
    changes = {"validate_every": (replace(recipe, validate_every=1), unseen)}
    changes["validation_frames"] = (replace(recipe, validation_frames=2), unseen)
    changes["validation"] = (recipe, others)
    for name, (changed, validation) in changes.items() if choice else ():
        with pytest.raises(SettingsError, match=rf"settings.json: {name}: expected .* as asked for now"):
            train(changed, data, run, "plain", validate=validation)
    if not choice:
        train(replace(recipe, validate_every=1, validation_frames=2), data, run, "plain", validate=others)


@pytest.mark.slow
def test_a_training_that_ended_early_is_resumed_with_the_same_bytes_and_then_left_alone(
    data: Path, tmp_path: Path
) -> None:
    choice = {"keep": "best", "ema": 0.9, "patience": 2, "validate_every": 1, "validation_share": 0.25, "epochs": 9}
    # At this rate nothing is found: the first validation stays the best and the second after it ends the training.
    recipe = tiny(learning_rate=1e-9, alarm_after=99, half=False, **choice)
    whole = train(recipe, data, tmp_path / "whole", "plain")
    with pytest.raises(RuntimeError, match="power cut"):
        train(recipe, data, tmp_path / "cut", "plain", callbacks=[Power(2)])
    cut = train(recipe, data, tmp_path / "cut", "plain")
    rows = [(tmp_path / run / "metrics.csv").read_text().splitlines() for run in ("whole", "cut")]
    assert len(rows[0]) == len(rows[1]) == 1 + 3
    expected = load_detector(whole).state_dict()
    for name, tensor in load_detector(cut).state_dict().items():
        assert torch.equal(tensor, expected[name]), name
    before = cut.read_bytes()
    assert train(recipe, data, tmp_path / "cut", "plain").read_bytes() == before
    assert len((tmp_path / "cut/metrics.csv").read_text().splitlines()) == 4
