"""Training end to end on a made-up drive: it learns, resumes, and says so when it goes wrong."""

import csv
import json
import shutil
import zipfile
from pathlib import Path

import lightning.pytorch as pl
import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.data.formats.opv2v.reader import DriveReader
from dsrc.data.sample import make_sample
from dsrc.evaluation.metrics.ap import FrameResult, evaluate
from dsrc.models.detector import Detector
from dsrc.models.fusion import FUSIONS
from dsrc.models.storage.checkpoint import load_detector, read_meta, save_detector
from dsrc.training.recipes import METHODS, Augmentation, debug, dsrc_code, of_method, override
from dsrc.training.train import train, train_stages
from sim.errors import CheckpointError, DataError, SettingsError
from sim.files import file_sha256, overwriting
from tests.dsrc.training.drive import write_drive
from tests.dsrc.training.runs import Power, tiny


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_drive(tmp_path_factory.mktemp("data"), 4)


@pytest.mark.parametrize(
    ("fusion", "choice"),
    [
        ("attention", {"epoch_frames": 2, "ema": 0.9, "half": False}),
        pytest.param("attention", {"keep": "best", "validation_share": 0.25, "half": False}, marks=pytest.mark.slow),
        pytest.param("cobevt", {}, marks=pytest.mark.slow),  # draws while it trains
        pytest.param(
            "max",
            {"consistency": 1.0, "augmentation": Augmentation(corruption=0.7, kinds=("noise", "point_dropping"))},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_resumed_training_ends_with_the_same_weights(
    data: Path, tmp_path: Path, fusion: str, choice: dict[str, object]
) -> None:
    recipe = replace(tiny(**choice), model=replace(tiny().model, fusion=fusion, direction=fusion == "max"))
    whole = train(recipe, data, tmp_path / "whole", "plain", seed=3)
    with pytest.raises(RuntimeError, match="power cut"):
        train(recipe, data, tmp_path / "cut", "plain", seed=3, callbacks=[Power(2)])
    resumed = train(recipe, data, tmp_path / "cut", "plain", seed=3)
    expected = load_detector(whole).state_dict()
    for name, tensor in load_detector(resumed).state_dict().items():
        torch.testing.assert_close(tensor, expected[name], rtol=0, atol=0)
    with (tmp_path / "cut/metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["epoch"] for row in rows] == ["0", "1", "2", "3"]
    # Nothing is held out without a share: the precision is that on training frames, and nothing is called validation.
    frames, others = ("val", "train") if recipe.validation_share else ("train", "val")
    assert [bool(row[f"{frames}/ap_bev_50"]) for row in rows] == [False, True, False, True]
    metrics = json.loads((tmp_path / "cut/result.json").read_text())["metrics"]
    assert {name for name in [*rows[0], *metrics] if name.startswith((f"{others}/ap", f"{others}/head"))} == set()
    assert len([name for name in metrics if name.startswith(f"{frames}/")]) == len(metrics) == 4
    for name in ("settings.json", "environment.json", "result.json", "curves.png"):
        assert (tmp_path / "cut" / name).exists(), name
    assert list((tmp_path / "cut/tensorboard").glob("events*"))


@pytest.mark.slow
def test_teacher_then_student_with_all_designs(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("dsrc.training.recipes", fromlist=["x"]).RECIPES, "debug", tiny)
    path = train_stages("debug", data=data, out=tmp_path, epochs=2)
    student = load_detector(path)
    assert path == tmp_path / "student/detector.pt"
    assert load_detector(tmp_path / "teacher/detector.pt").settings.point_features == 5
    with (tmp_path / "student/metrics.csv").open() as file:
        row = list(csv.DictReader(file))[-1]
    assert {"train/dae", "train/daf", "train/dap", "train/rec_mask", "train/rec_offset"} <= set(row)
    sample = make_sample(DriveReader(data / "made_up").read(0), 1000, student.settings.grid)
    student.detect(sample)


@pytest.mark.parametrize(
    "fusion", ["late", "where2comm", *(pytest.param(one, marks=pytest.mark.slow) for one in ("none", "early"))]
)
def test_other_fusions_train_and_detect(data: Path, tmp_path: Path, fusion: str) -> None:
    recipe = tiny()
    path = train(replace(recipe, epochs=1, model=replace(recipe.model, fusion=fusion)), data, tmp_path, "plain")
    detector = load_detector(path)
    detector.detect(make_sample(DriveReader(data / "made_up").read(0), 1000, detector.settings.grid))


def test_a_finished_training_is_left_as_it_is(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recipe = tiny(epochs=1)
    path = train(recipe, data, tmp_path, "plain")
    before = {file: file.read_bytes() for file in tmp_path.rglob("*") if file.is_file()}
    monkeypatch.setattr("dsrc.training.run_folder.versions", lambda: {"torch": "later"})
    monkeypatch.setattr("dsrc.runs.provenance.versions", lambda: {"torch": "later"})
    assert train(replace(recipe, validate_every=1, validation_frames=1), data, tmp_path, "plain") == path
    changed = [file.name for file in tmp_path.rglob("*") if file.is_file() and file.read_bytes() != before[file]]
    assert changed == ["environment.json"]
    starts = json.loads((tmp_path / "environment.json").read_text())
    assert [start["versions"] == {"torch": "later"} for start in starts] == [False, True]
    assert read_meta(path)["metrics"]


def test_a_run_that_was_cut_off_between_its_detector_and_its_result_keeps_its_record(
    data: Path, tmp_path: Path
) -> None:
    path = train(tiny(epochs=1), data, tmp_path, "plain")
    result = tmp_path / "result.json"
    before = {file: file.read_bytes() for file in (path, result, tmp_path / "settings.json")}
    result.unlink()
    train(tiny(epochs=1, validate_every=1), data, tmp_path, "plain")
    assert {file: file.read_bytes() for file in before} == before


def test_a_checkpoint_in_which_a_byte_was_flipped_is_told_wherever_it_is(data: Path, tmp_path: Path) -> None:
    with pytest.raises(RuntimeError, match="power cut"):
        train(tiny(epochs=2), data, tmp_path, "plain", callbacks=[Power(1)])
    last = tmp_path / "checkpoints/last.ckpt"
    whole = last.read_bytes()
    with zipfile.ZipFile(last) as file:
        names = file.namelist()
        spots = [whole.index(file.read(name)[:4000]) + 10 for name in (names[0], max(names, key=len))]
    for spot in (*spots, whole.rindex(b"PK\x01\x02") + 50):
        last.write_bytes(whole[:spot] + bytes(255 - b for b in whole[spot : spot + 4]) + whole[spot + 4 :])
        with pytest.raises(CheckpointError, match=r"last.ckpt: file: .* remove it to start afresh"):
            train(tiny(epochs=2), data, tmp_path, "plain")


def test_a_run_is_resumed_with_what_it_was_started_with_or_not_at_all(data: Path, tmp_path: Path) -> None:
    recipe = tiny(epochs=1)
    train(recipe, data, tmp_path, "plain")
    written = (tmp_path / "settings.json").read_bytes()
    wider = replace(recipe, model=replace(recipe.model, decoder_channels=16))
    with pytest.raises(SettingsError, match=r"model.decoder_channels: expected 16 as asked for now, found 8"):
        train(wider, data, tmp_path, "plain")
    with pytest.raises(SettingsError, match=r"learning_rate: expected 1.0 as asked for now, found 0.004"):
        train(replace(recipe, learning_rate=1.0), data, tmp_path, "plain")
    with pytest.raises(SettingsError, match=r"seed: expected 4 as asked for now, found 0"):
        train(recipe, data, tmp_path, "plain", seed=4)
    assert (tmp_path / "settings.json").read_bytes() == written
    several = {"warmup": 0.5, "learning_rate": 1.0, "weight_decay": 0.0, "ema": 0.5, "clip": 1.0, "reconstruction": 2.0}
    with pytest.raises(SettingsError, match=r"clip: expected 1.0 as asked for now"):  # always the same one
        train(replace(recipe, **several), data, tmp_path, "plain", seed=4)
    train(replace(recipe, workers=0, alarm_after=9), data, tmp_path, "plain")
    with pytest.raises(SettingsError, match=r"half: expected False as asked for now, found True"):
        train(replace(recipe, half=False), data, tmp_path, "plain")
    record = json.loads(written)
    record["settings"]["recipe"]["comm_range_m"] = record["settings"]["recipe"]["model"].pop("comm_range_m")
    (tmp_path / "settings.json").write_text(json.dumps(record))  # as versions before wrote it
    train(recipe, data, tmp_path, "plain")
    nearer = replace(recipe, model=replace(recipe.model, comm_range_m=30.0))
    with pytest.raises(SettingsError, match=r"model.comm_range_m: expected 30.0 as asked for now, found 70.0"):
        train(nearer, data, tmp_path, "plain")
    (tmp_path / "settings.json").unlink()
    with overwriting(), pytest.raises(SettingsError, match=r"settings.json: file: expected the settings of the run in"):
        train(recipe, data, tmp_path, "plain")


def test_a_run_that_is_begun_anew_and_cut_off_is_not_continued_from_the_former_one(data: Path, tmp_path: Path) -> None:
    train(tiny(epochs=1), data, tmp_path, "plain")
    other = tiny(epochs=1, learning_rate=1e-3)
    with pytest.raises(RuntimeError, match="power cut"):
        train(other, data, tmp_path, "plain", resume=False, callbacks=[Power(0)])
    assert not list((tmp_path / "checkpoints").glob("*"))
    train(other, data, tmp_path, "plain")
    with (tmp_path / "metrics.csv").open() as file:
        assert len(list(csv.DictReader(file))) == 1


def test_a_folder_is_trained_in_by_one_process_at_a_time(data: Path, tmp_path: Path) -> None:
    class Second(pl.Callback):
        def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            train(tiny(epochs=1), data, tmp_path, "plain", seed=2)

    with pytest.raises(DataError, match="is writing this training"):
        train(tiny(epochs=1), data, tmp_path, "plain", seed=1, callbacks=[Second()])


def test_a_detector_without_its_run_is_not_replaced(data: Path, tmp_path: Path) -> None:
    save_detector(tmp_path / "detector.pt", Detector(tiny().settings("plain")), half=True)
    before = file_sha256(tmp_path / "detector.pt")
    with pytest.raises(SettingsError, match=r"detector.pt: output: .*, found a detector without its run"):
        train(tiny(epochs=1), data, tmp_path, "plain")
    assert file_sha256(tmp_path / "detector.pt") == before


def test_a_damaged_frame_is_one_line_from_a_process_that_prepares_batches_too(data: Path, tmp_path: Path) -> None:
    shutil.copytree(data, tmp_path / "data")
    cloud = next((tmp_path / "data").rglob("*.pcd"))
    cloud.write_bytes(cloud.read_bytes()[:200])
    for workers in (0, 1):
        with pytest.raises(DataError) as caught:
            train(tiny(epochs=1, workers=workers), tmp_path / "data", tmp_path / str(workers), "plain")
        assert cloud.name in str(caught.value) and "\n" not in str(caught.value)
        assert "Traceback" not in str(caught.value)


def test_frames_that_are_trained_on_are_not_called_validation(data: Path, tmp_path: Path) -> None:
    path = train(tiny(epochs=1, validate_every=1), data, tmp_path / "same", "plain", validate=data)
    metrics = json.loads((path.parent / "result.json").read_text())["metrics"]
    assert metrics and all(name.startswith("train/") for name in metrics)
    with pytest.raises(SettingsError, match="keep: expected frames that are not trained on"):
        train(tiny(epochs=1, keep="best"), data, tmp_path / "best", "plain", validate=data)


@pytest.mark.parametrize(
    ("options", "stages"),
    [
        ({}, ["teacher", "student"]),
        ({"teacher": Path("given.pt")}, ["student"]),
        ({"stage": "teacher"}, ["teacher"]),
        ({"method": "attfuse"}, ["student"]),
    ],
)
def test_a_teacher_is_trained_unless_it_is_given_or_not_needed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: dict[str, object], stages: list[str]
) -> None:
    done = []

    def note(recipe: object, data: Path, out: Path, stage: str, *, teacher: Path | None, **_: object) -> Path:
        done.append((stage, teacher))
        return out

    monkeypatch.setattr("dsrc.training.train.train", note)
    train_stages("debug", data=tmp_path, out=tmp_path, **options)
    assert [stage for stage, _ in done] == stages
    given = options.get("teacher") or (tmp_path / "teacher/detector.pt" if stages == ["teacher", "student"] else None)
    assert done[-1][1] == given


@pytest.mark.parametrize("options", [{"method": "attfuse"}, {"stage": "plain"}, {"stage": "teacher"}])
def test_a_teacher_that_would_not_be_used_is_refused(tmp_path: Path, options: dict[str, object]) -> None:
    with pytest.raises(SettingsError, match="trained without a teacher; leave out --teacher"):
        train_stages("debug", data=tmp_path, out=tmp_path, teacher=Path("given.pt"), **options)


def test_a_training_starts_from_the_weights_that_fit(data: Path, tmp_path: Path) -> None:
    first = train(tiny(epochs=1), data, tmp_path / "first", "plain")
    # A rate of almost nothing keeps what is trained at what it was started from.
    still = tiny(learning_rate=1e-12, epochs=1)
    wider = replace(still, model=replace(still.model, decoder_channels=16))
    path = train(wider, data, tmp_path / "second", "plain", seed=1, init=first)
    expected, found = load_detector(first).state_dict(), load_detector(path).state_dict()
    torch.testing.assert_close(found["reg_head.weight"], expected["reg_head.weight"])
    assert found["shrink.0.weight"].shape != expected["shrink.0.weight"].shape
    start = read_meta(path)["init"]
    weights = {name for name, tensor in found.items() if tensor.is_floating_point()}
    same = {name for name in weights if found[name].shape == expected[name].shape}
    assert (start["tensors_taken"], start["tensors"]) == (len(same), len(weights))
    assert start["sha256"] == file_sha256(first)
    with pytest.raises(SettingsError, match=r"init: expected None as asked for now, found"):
        train(wider, data, tmp_path / "second", "plain", seed=1)


@pytest.mark.slow
def test_a_teacher_that_starts_from_a_plain_student_sees_bare_points_as_that_does(data: Path, tmp_path: Path) -> None:
    first = train(tiny(epochs=1), data, tmp_path / "first", "plain")
    path = train(tiny(learning_rate=1e-12, epochs=1), data, tmp_path / "second", "teacher", seed=1, init=first)
    bare, painted = (load_detector(p).encoder.linear.weight for p in (first, path))
    x_y_z_intensity = [0, 1, 2, 3]
    torch.testing.assert_close(painted[:, [*x_y_z_intensity, *range(5, 11)]], bare, atol=2e-3, rtol=0)
    assert painted[:, 4].abs().max() < 1e-6
    assert read_meta(path)["init"]["tensors_taken"] == read_meta(path)["init"]["tensors"]


def test_a_start_of_which_nothing_fits_is_refused(data: Path, tmp_path: Path) -> None:
    sizes = {"pillar_channels": 24, "stage_channels": (24, 40, 48), "decoder_channels": 24, "shrink_channels": 48}
    save_detector(tmp_path / "other.pt", Detector(replace(tiny().model, **sizes)))
    with pytest.raises(CheckpointError, match=r"other.pt: state: expected a weight .* found none"):
        train(tiny(), data, tmp_path / "run", "plain", init=tmp_path / "other.pt")
    with pytest.raises(CheckpointError, match="no such checkpoint file"):
        train(tiny(), data, tmp_path / "run", "plain", init=tmp_path / "nowhere.pt")


def test_a_setting_is_of_the_model_of_the_recipe_or_of_a_part_of_it() -> None:
    texts = ["fusion=max", "epochs=3", "augmentation.dropout=0.5", "model.sdd=false", "labels.foreground=boxes"]
    changed = override(debug(), texts)
    assert (changed.model.fusion, changed.model.sdd, changed.epochs) == ("max", False, 3)
    assert changed.augmentation == replace(debug().augmentation, dropout=0.5)
    assert changed.labels.foreground == "boxes"
    assert (
        override(changed, ["fusion=attention", "epochs=60", "augmentation.dropout=0", "sdd=true"]).model
        == debug().model
    )


def test_settings_that_go_together_may_come_in_any_order() -> None:
    together = ["users=vulnerable", "labels.targets=overlap", "direction=false"]
    assert override(dsrc_code(), together) == override(dsrc_code(), together[::-1])
    with pytest.raises(SettingsError, match=r"^--set: labels.targets: expected overlap with users=vulnerable"):
        override(dsrc_code(), together[::2])


WRONG = [
    "batch_size=0",
    "learning_rate=nan",
    "score_prior=2",
    'grid={"cell_m":0.3}',
    "seed",
    "labels.dropout=1",
    "a.b=1",
    "learning_rate=inf",
    "distill.dae=-1",
    "distill.daf=nan",
    "augmentation.scale=0.999",
    "reconstruction_cell_z_m=0.2",
]


@pytest.mark.parametrize("text", [*WRONG, 'augmentation.kinds=["fogg"]', 'augmentation.kinds=["pose_error"]'])
def test_a_setting_that_cannot_be_is_named(text: str) -> None:
    with pytest.raises(SettingsError, match=text.partition("=")[0]):
        override(debug(), [text])


def test_a_nan_stops_the_training_with_one_line(data: Path, tmp_path: Path) -> None:
    class Poison(pl.Callback):
        def on_train_epoch_start(self, trainer: pl.Trainer, pl_module: pl.LightningModule) -> None:
            torch.nn.init.constant_(pl_module.detector.cls_head.bias, torch.nan)

    from dsrc.training.module import TrainingAlarm

    with pytest.raises(TrainingAlarm, match=r"loss: expected a finite number, found .* nan.* epoch 0, step 0"):
        train(tiny(), data, tmp_path, "plain", callbacks=[Poison()])


@pytest.mark.slow
def test_an_ap_that_stays_zero_stops_the_training(data: Path, tmp_path: Path) -> None:
    from dsrc.training.module import TrainingAlarm

    recipe = tiny(learning_rate=1e-9, alarm_after=2)
    with pytest.raises(TrainingAlarm, match=r"AP@0\.3 on training frames: .* found 0 in 2 validations"):
        train(recipe, data, tmp_path, "plain")


@pytest.mark.slow
def test_an_interruption_does_not_put_the_alarm_off(data: Path, tmp_path: Path) -> None:
    from dsrc.training.module import TrainingAlarm

    recipe = tiny(learning_rate=1e-9, alarm_after=3, validate_every=1)
    with pytest.raises(RuntimeError, match="power cut"):
        train(recipe, data, tmp_path, "plain", callbacks=[Power(2)])
    with pytest.raises(TrainingAlarm, match="by epoch 2, found 0 in 3 validations"):
        train(recipe, data, tmp_path, "plain")


def test_a_student_without_its_teacher_is_told(data: Path, tmp_path: Path) -> None:
    with pytest.raises(CheckpointError, match="no such checkpoint file"):
        train_stages("debug", data=data, out=tmp_path, stage="student")
    with pytest.raises(SettingsError, match="did you mean 'fusion'"):
        train_stages("debug", data=data, out=tmp_path, set=("fusoin=max",))
    with pytest.raises(SettingsError, match="did you mean 'debug'"):
        train_stages("debgu", data=data, out=tmp_path)
    with pytest.raises(SettingsError, match="seed: expected at least 0 and below 2147483648, found 4294967296"):
        train_stages("debug", data=data, out=tmp_path, seed=2**32)
    with pytest.raises(SettingsError, match=r"method: expected one of .*early.*v2x-vit.*dsrc.*, found foo"):
        train_stages("debug", data=data, out=tmp_path, method="foo")


def test_methods_differ_in_their_fusion_and_designs_alone() -> None:
    for name in METHODS:
        changed = of_method(debug(), name)
        settings = replace(changed.model, **{k: getattr(debug().model, k) for k in ("fusion", "sdd", "pcp", "rec")})
        assert replace(changed, model=settings) == debug(), name
    assert {METHODS[name]["fusion"] for name in METHODS} == set(FUSIONS)


@pytest.mark.slow
def test_a_rival_is_trained_without_a_teacher(data: Path, tmp_path: Path) -> None:
    sizes = ("shrink_channels=16", "stage_channels=[8,8,8]", "alarm_after=9")
    path = train_stages("debug", data=data, out=tmp_path, epochs=1, method="v2x-vit", set=sizes)
    assert not (tmp_path / "teacher").exists()
    assert load_detector(path).settings.fusion == "v2xvit"


@pytest.mark.slow
def test_debug_learns_four_frames_by_heart(data: Path, tmp_path: Path) -> None:
    detector = load_detector(train_stages("debug", data=data, out=tmp_path, seed=0))
    reader = DriveReader(data / "made_up")
    samples = [make_sample(reader.read(i), 1000, detector.settings.grid) for i in range(4)]
    results = [FrameResult(detector.detect(sample), sample.boxes) for sample in samples]
    assert evaluate(results).curves["bev", 0.5].ap >= 0.9
    assert sum(len(r.truth) for r in results) >= 20
    assert np.isfinite([r.detections.score.sum() for r in results]).all()
