"""train: one stage of a recipe on a folder of drives, resumable, into one run folder."""

import logging
import os
import sys
import warnings
import zipfile
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import lightning.pytorch as pl
import msgspec
import torch
from lightning.fabric.utilities.warnings import PossibleUserWarning
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from msgspec.structs import replace

from dsrc.data.drives import list_drives
from dsrc.data.provenance import hash_file, hashes, provenance
from dsrc.models.detector import Detector
from dsrc.models.settings import ModelSettings
from dsrc.models.storage.checkpoint import load_detector, save_detector, with_fusion
from dsrc.training.averaging import Selection
from dsrc.training.datamodule import DetectionData
from dsrc.training.metrics_file import MetricsFile, ValidateLast, note_environment, write_json
from dsrc.training.module import DetectionModule
from dsrc.training.recipes import RECIPES, Recipe, Stage, of_method
from dsrc.training.validation import best_device
from dsrc.training.validation import validate as validate_detector
from sim.errors import CheckpointError, SettingsError, complaint, did_you_mean

LOG = logging.getLogger(__name__)
DETECTOR, SETTINGS, RESULT = "detector.pt", "settings.json", "result.json"
"""Files of a run folder."""
_PARTS = ("model", "distill", "labels", "augmentation")
_OF_A_TEACHER = ("grid", "sdd", "pcp", "stage_channels", "shrink_channels", "box_order")
_FIRST = "encoder.linear.weight"
_WITHOUT_EFFECT = ("name", "alarm_after", "workers", "half")
"""Fields of a recipe that do not change the weights."""
_OF_THE_CHOICE = ("validate_every", "validation_frames")
"""Those that do where validations choose the weights, or the end of the training."""

logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)


def train_stages(
    recipe: str,
    *,
    data: Path,
    out: Path,
    stage: Literal["all", "teacher", "student", "plain"] = "all",
    teacher: Path | None = None,
    validate: Path | None = None,
    seed: int = 0,
    epochs: int | None = None,
    overrides: Sequence[str] = (),
    method: str | None = None,
    init: Path | None = None,
    devices: int = 1,
) -> Path:
    """Train one stage, or the teacher and then the student, each in its own subfolder of `out`.

    Args:
        recipe: a key of `RECIPES`.
        data: folder of drives.
        out: run folder.
        stage: `all` is teacher, then student; a student that does not distil needs no teacher.
        teacher: detector file of a trained teacher; default: the one in `out`.
        validate: folder of drives to validate on; None holds out the end of each training drive.
        seed: of weights, order and augmentation.
        epochs: instead of the recipe's.
        overrides: `field=value` of `ModelSettings`, of the recipe when the model has no such field, or of a part of it,
            as `augmentation.dropout=0`.
        method: a key of `METHODS`; None is what the recipe and the overrides say.
        init: detector file whose weights every stage starts from, see `train`.
        devices: processes that train together, see `train`.

    Returns:
        The detector file of the last stage.
    """
    if seed < 0:
        raise SettingsError(complaint("train", "seed", "at least 0", seed))
    if recipe not in RECIPES:
        raise SettingsError(f"recipe: unknown '{recipe}'{did_you_mean(recipe, RECIPES)}")
    chosen = RECIPES[recipe]() if method is None else of_method(RECIPES[recipe](), method)
    chosen = override(chosen, overrides)
    if epochs is not None:
        chosen = replace(chosen, epochs=epochs)
    if chosen.epochs < 1:
        raise SettingsError(complaint("recipe", "epochs", "at least 1", chosen.epochs))
    stages: list[Stage] = ["teacher", "student"] if stage == "all" else [stage]
    if stage == "all" and not chosen.model.distils:
        stages = ["student"]
    path = out
    for part in stages:
        known = teacher
        if part == "student" and known is None and chosen.model.distils:
            known = out / "teacher" / DETECTOR
        path = train(
            chosen, data, out / part, part, teacher=known, validate=validate, seed=seed, init=init, devices=devices
        )
    return path


def train(
    recipe: Recipe,
    data: Path,
    out: Path,
    stage: Stage,
    *,
    teacher: Path | None = None,
    validate: Path | None = None,
    resume: bool = True,
    seed: int = 0,
    init: Path | None = None,
    devices: int = 1,
    callbacks: Sequence[pl.Callback] = (),
) -> Path:
    """Train one stage.

    The run folder gets

    * `settings.json`: recipe, seed, versions, hashes of the data, of the teacher and of the start,
    * `environment.json`: the machine and its libraries, once more for each start on another,
    * `metrics.csv`: one row per epoch, and `curves.png`, the same drawn; `tensorboard/` where that is installed,
    * `checkpoints/last.ckpt` to resume from and, where a recipe keeps the best weights, `checkpoints/best.pt`,
    * `detector.pt` to use, and `result.json`: its hash and its average precision. `dsrc verify` compares with them.

    Several devices, or `torchrun`'s processes, share each batch and average their gradients: a step is that of one
    device, but for what looks at a batch as a whole. Batch norms take their statistics from a device's own share of
    it (the running ones, which a detector uses, are those of the first device), and the distillation and
    reconstruction losses, means over foreground, are averaged by device and not by cell.

    Args:
        recipe: what to do.
        data: folder of drives.
        out: run folder.
        stage: `teacher` reads clouds made with ground truth; `student` is the recipe's model; `plain` is it without
            distillation and reconstruction.
        teacher: detector file of a teacher, for a student that distils.
        validate: folder of drives to validate on; None holds out the end of each training drive.
        resume: continue from the run folder's last checkpoint if there is one; a run interrupted and resumed ends with
            the same weights as one that was not. A finished one is left as it is, but for `environment.json`.
        seed: of weights, order and augmentation.
        init: detector file to start from: of its weights all are taken whose name and shape agree; the record says
            how many those are.
        devices: GPUs, or processes where there is no GPU, that train together on this machine; under `torchrun` it is
            `torchrun` that says how many and where.
        callbacks: further Lightning callbacks.

    Returns:
        The detector file.

    Raises:
        DataError: the data is missing or wrong.
        CheckpointError: the teacher or the start is missing or does not fit, or the checkpoint is damaged.
        SettingsError: the run to resume was started with other settings, data, teacher or start; the recipe asks for
            the best weights and there is nothing to validate on; the batch cannot be shared among the devices.
        TrainingAlarm: the loss became NaN, or nothing is ever detected.
    """
    settings = recipe.settings(stage)
    taught_by = _teacher(teacher, settings) if stage == "student" and settings.distils else None
    drives = list_drives(data)
    validation = None if validate is None else list_drives(validate)
    per_node, nodes = _world(recipe, devices)
    loaders = DetectionData(recipe, settings, drives, validation, seed)
    _check_frames(recipe, loaders, per_node * nodes)
    out.mkdir(parents=True, exist_ok=True)
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        module = DetectionModule(recipe, Detector(settings), taught_by, seed)
    record = _record(recipe, stage, seed, drives, validation, teacher if taught_by else None)
    record["init"] = None if init is None else start_from(init, module.detector)
    record["devices"] = per_node * nodes
    last, path, result = out / "checkpoints" / "last.ckpt", out / DETECTOR, out / RESULT
    finished = resume and path.exists() and result.exists()
    resume = resume and last.exists()
    if finished or resume:
        _check_same_run(out / SETTINGS, record)
    if finished:
        if leads():
            note_environment(out / "environment.json", per_node * nodes)
        return path
    if resume:
        _check_whole(last)
    selection = Selection(recipe, out / "checkpoints" / "best.pt")
    with warnings.catch_warnings():
        # Advice about workers and log steps, which are the recipe's choice, and about Lightning's own inside.
        warnings.simplefilter("ignore", PossibleUserWarning)
        warnings.filterwarnings("ignore", message=".*LeafSpec")
        warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")
        trainer = _trainer(recipe, out, per_node, nodes, [selection, *callbacks])
        if trainer.is_global_zero:
            if not resume:
                # An earlier run's are none of this one's, should it be cut off before it writes its own.
                path.unlink(missing_ok=True)
                result.unlink(missing_ok=True)
            if not path.exists():
                folders = {"data": str(data.resolve()), "validate": validate and str(validate.resolve())}
                write_json(out / SETTINGS, {**record, "folders": folders})
            note_environment(out / "environment.json", per_node * nodes)
        trainer.fit(module, loaders, ckpt_path=str(last) if resume else None)
    if trainer.interrupted:
        raise KeyboardInterrupt
    # The detector may be there, as `settings.json` says: a run can be cut off while its result is computed.
    if trainer.is_global_zero and not path.exists():
        selection.apply(module.detector)
        meta = {**record, "epoch": selection.epoch, "metrics": selection.metrics}
        save_detector(path, module.detector, meta, half=recipe.half)
    if trainer.is_global_zero:
        metrics = validate_detector(load_detector(path, best_device()), loaders.validation_batches())
        write_json(result, {"detector": hash_file(path), "epoch": selection.epoch, "metrics": metrics})
    trainer.strategy.barrier()  # the next stage of every process reads the file
    return path


def leads() -> bool:
    """Return whether this process is the first, or the only one, of those that share a training."""
    return not getattr(rank_zero_only, "rank", None)


def override(recipe: Recipe, overrides: Sequence[str]) -> Recipe:
    """Return the recipe with `field=value` of its model, of itself, or of a part (`augmentation.dropout=0`) changed.

    Raises:
        SettingsError: no such field, or a value of another type.
    """
    parts = {part: getattr(recipe, part).__struct_fields__ for part in _PARTS}
    for text in overrides:
        name, _, value = text.partition("=")
        part, _, field = name.rpartition(".")
        if name in parts["model"]:
            part = "model"
        if field not in parts.get(part, Recipe.__struct_fields__ if not part else ()):
            dotted = [f"{part}.{field}" for part, fields in parts.items() if part != "model" for field in fields]
            known = [*parts["model"], *Recipe.__struct_fields__, *dotted]
            raise SettingsError(f"--set {name}: no such setting{did_you_mean(name, known)}")
        try:
            parsed = msgspec.json.decode(value)
        except msgspec.DecodeError:
            parsed = value
        plain = msgspec.to_builtins(recipe)
        (plain[part] if part else plain)[field] = parsed
        try:
            recipe = msgspec.convert(plain, Recipe, strict=False)
        except msgspec.ValidationError as error:
            raise SettingsError(f"--set {text}: {error}") from None
    return recipe


def _teacher(path: Path | None, student: ModelSettings) -> Detector:
    """Load a teacher and compare what must be equal for its features to be a model for the student's.

    It joins the agents' maps as the student does: a teacher of single clouds would see the ego's alone, and teach that
    there is nothing where only a collaborator has points.
    """
    if path is None:
        raise CheckpointError("teacher: a student with sdd or pcp needs a teacher's detector.pt; train it first")
    teacher = load_detector(path)
    wanted = {"role": "teacher"}
    wanted |= {name: getattr(student, name) for name in _OF_A_TEACHER}
    for name, value in wanted.items():
        if getattr(teacher.settings, name) != value:
            raise CheckpointError(complaint(path, name, f"{value} as the student's", getattr(teacher.settings, name)))
    try:
        return with_fusion(teacher, student.fusion)
    except CheckpointError:
        expected = f"{student.fusion} as the student's, which has weights of its own"
        raise CheckpointError(complaint(path, "fusion", expected, teacher.settings.fusion)) from None


def _world(recipe: Recipe, devices: int) -> tuple[int, int]:
    """Return how many processes train on this machine, and on how many machines."""
    if "TORCHELASTIC_RUN_ID" in os.environ:
        per_node, nodes = int(os.environ["LOCAL_WORLD_SIZE"]), int(os.environ["GROUP_WORLD_SIZE"])
    else:
        per_node, nodes = devices, 1
    if per_node < 1:
        raise SettingsError(complaint("train", "devices", "at least 1", per_node))
    if torch.cuda.is_available() and per_node > torch.cuda.device_count():
        raise SettingsError(complaint("train", "devices", f"at most {torch.cuda.device_count()} GPUs", per_node))
    if recipe.batch_size % (per_node * nodes):
        raise SettingsError(
            complaint("recipe", "batch_size", f"a multiple of the {per_node * nodes} devices", recipe.batch_size)
        )
    return per_node, nodes


def _check_frames(recipe: Recipe, loaders: DetectionData, devices: int) -> None:
    """Refuse data that the recipe cannot be followed on."""
    frames = min(len(loaders.training), recipe.epoch_frames or len(loaders.training))
    if frames < devices:
        raise SettingsError(complaint("recipe", "epoch_frames", f"at least one for each of {devices} devices", frames))
    choosing = _chooses_by(recipe.keep, recipe.patience)
    if choosing and not loaders.validates_on_unseen:
        hint = "; give validation drives or a validation_share"
        raise SettingsError(complaint("recipe", choosing, "frames that are not trained on, to choose by", "none", hint))


def _chooses_by(keep: str, patience: int | None) -> str | None:
    """Return the field of a recipe by which validations decide over the weights, if there is one."""
    return "keep" if keep == "best" else "patience" if patience is not None else None


def start_from(path: Path, detector: Detector) -> dict[str, object]:
    """Copy the weights of a detector file that fit, by name and shape; return what was done, for the record.

    A network of painted points takes the first layer of one of bare points and treats paint as that does: not at all.
    One of bare points takes that of painted points without the paint, so that a student can begin as its teacher.
    """
    own = detector.state_dict()
    start = load_detector(path)
    theirs = start.state_dict()
    first, paint = theirs[_FIRST], 4
    painted, wanted = start.settings.point_features > paint, detector.settings.point_features > paint
    if wanted and not painted:
        theirs[_FIRST] = torch.cat([first[:, :paint], torch.zeros_like(first[:, :1]), first[:, paint:]], dim=1)
    if painted and not wanted:
        theirs[_FIRST] = torch.cat([first[:, :paint], first[:, paint + 1 :]], dim=1)
    fitting = {name: t for name, t in theirs.items() if name in own and own[name].shape == t.shape}
    if all(tensor.ndim < 2 for tensor in fitting.values()):  # the heads' biases and the steps' counters always fit
        raise CheckpointError(complaint(path, "state", "a weight of the name and shape of the network's", "none"))
    taken, whole = (sum(t.is_floating_point() for t in tensors.values()) for tensors in (fitting, own))
    detector.load_state_dict(own | fitting)
    LOG.info("%s: %d of %d tensors taken", path, taken, whole)
    return {"sha256": hash_file(path), "tensors_taken": taken, "tensors": whole}


def _check_whole(last: Path) -> None:
    """Compare the parts of a checkpoint with their checksums, which torch's reader does not look at."""
    try:
        with zipfile.ZipFile(last) as file:
            whole = file.testzip() is None
    except Exception:  # of a damaged directory, the reader says so by whatever error it runs into
        whole = False
    if not whole:
        raise CheckpointError(complaint(last, "file", "a checkpoint", "a damaged one", "; remove it to start afresh"))


def _check_same_run(settings: Path, record: dict) -> None:
    """Compare what made a run that is there with what is asked for now."""
    if not settings.exists():
        return
    try:
        before, now = _made_of(msgspec.json.decode(settings.read_bytes())), _made_of(record)
    except (msgspec.DecodeError, KeyError, TypeError, AttributeError):
        raise SettingsError(complaint(settings, "file", "the settings of a training", "something else")) from None
    for name in sorted(before.keys() & now.keys()):
        if before[name] != now[name]:
            hint = "; choose another folder or remove this one"
            raise SettingsError(complaint(settings, name, f"{now[name]} as asked for now", before[name], hint))


def _made_of(record: dict) -> dict[str, object]:
    """Return by name what decides over the weights of a run."""
    plain = msgspec.json.decode(msgspec.json.encode(record))
    recipe = plain["settings"]["recipe"]
    parts = {f"{part}.{name}": value for part in _PARTS for name, value in recipe.get(part, {}).items()}
    chooses = _chooses_by(recipe.get("keep", "last"), recipe.get("patience"))
    chosen = {"validation": sorted((plain["validation"] or {}).values())} if chooses else {}
    left_out = {*_PARTS, *_WITHOUT_EFFECT, *(() if chooses else _OF_THE_CHOICE)}
    whole = {name: value for name, value in recipe.items() if name not in left_out}
    return {
        **parts,
        **whole,
        **chosen,
        "stage": plain["settings"]["stage"],
        "seed": plain["seed"],
        "data": sorted(plain["data"].values()),
        "teacher": plain["teacher"],
        "init": (plain.get("init") or {}).get("sha256"),
        "devices": plain.get("devices", 1),
        "own validation drives": plain["validation"] is not None,
    }


def _trainer(recipe: Recipe, out: Path, per_node: int, nodes: int, callbacks: Sequence[pl.Callback]) -> pl.Trainer:
    keep = ModelCheckpoint(
        out / "checkpoints", filename="last", save_top_k=1, enable_version_counter=False, save_on_train_epoch_end=True
    )
    shown = [RichProgressBar()] if sys.stderr.isatty() else []
    try:
        logger: TensorBoardLogger | bool = TensorBoardLogger(out, name="tensorboard", version="")
    except ModuleNotFoundError:
        logger = False
    return pl.Trainer(
        max_epochs=recipe.epochs,
        accelerator="auto",
        devices=per_node,
        num_nodes=nodes,
        # Not every step of every method uses every weight: alone, an ego has nothing to fuse.
        strategy="ddp_find_unused_parameters_true" if per_node * nodes > 1 else "auto",
        use_distributed_sampler=False,
        logger=logger,
        callbacks=[ValidateLast(recipe.validate_every), MetricsFile(out), keep, *shown, *callbacks],
        gradient_clip_val=recipe.clip,
        num_sanity_val_steps=0,
        log_every_n_steps=10,
        enable_progress_bar=bool(shown),
        enable_model_summary=False,
        default_root_dir=out,
    )


def _record(
    recipe: Recipe, stage: Stage, seed: int, drives: list[Path], validation: list[Path] | None, teacher: Path | None
) -> dict:
    """Return everything that made a training: settings, seed, versions, data."""
    return {
        **provenance({"recipe": msgspec.to_builtins(recipe), "stage": stage}, seed, drives),
        "validation": None if validation is None else hashes(validation),
        "teacher": None if teacher is None else hash_file(teacher),
    }
