"""Training: one stage of a recipe on a folder of drives, resumable, in one run folder."""

import logging
import os
import sys
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

import lightning.pytorch as pl
import msgspec
import torch
from lightning.fabric.utilities.warnings import PossibleUserWarning
from lightning.pytorch.callbacks import ModelCheckpoint, RichProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from lightning.pytorch.utilities import rank_zero_only
from msgspec.structs import replace

from dsrc.data.drives import drive_hashes, list_drives
from dsrc.models.detector import Detector
from dsrc.models.layers.half_products import half_products
from dsrc.models.storage.checkpoint import load_detector, save_detector
from dsrc.options.detection import TrainOptions
from dsrc.options.fields import takes_fields
from dsrc.runs.lock import locked
from dsrc.runs.provenance import provenance
from dsrc.training.averaging import WeightSelection
from dsrc.training.datamodule import DetectionData
from dsrc.training.initialise import initialise_from, load_teacher
from dsrc.training.metrics_file import MetricsFile, ValidationSchedule
from dsrc.training.module import DetectionModule
from dsrc.training.recipes import RECIPES, Recipe, Stage, of_method, override
from dsrc.training.run_folder import DETECTOR, RunFolder, validations_decide, write_json
from dsrc.training.validation import best_device
from dsrc.training.validation import validate as validate_detector
from sim.errors import SettingsError, UserError, complaint, did_you_mean
from sim.files import check_folder, file_sha256
from sim.machine import keep_memory

LOG = logging.getLogger(__name__)
_SEEDS = 2**31
"""Seeds are below this: generators of 64 bits get one beside a step's number."""
logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)


@takes_fields(TrainOptions)
def train_stages(options: TrainOptions) -> Path:
    """Train one stage, or the teacher and then the student, each in its own subfolder of the run folder.

    A student that does not distil needs no teacher, and one whose teacher is given gets no other.

    Args:
        options: recipe, drives, run folder and more, see `TrainOptions`; or these as arguments.

    Returns:
        The detector file of the last stage.

    Raises:
        UserError: as `train`, or an option is wrong.
    """
    if not 0 <= options.seed < _SEEDS:
        raise SettingsError(complaint("train", "seed", f"at least 0 and below {_SEEDS}", options.seed))
    if options.recipe not in RECIPES:
        raise SettingsError(f"recipe: unknown '{options.recipe}'{did_you_mean(options.recipe, RECIPES)}")
    recipe = RECIPES[options.recipe]()
    if options.method is not None:
        recipe = of_method(recipe, options.method)
    recipe = override(recipe, options.set)
    if options.epochs is not None:
        recipe = replace(recipe, epochs=options.epochs)
    if recipe.epochs < 1:
        raise SettingsError(complaint("recipe", "epochs", "at least 1", recipe.epochs))
    if options.teacher and not (recipe.model.distils and options.stage in ("all", "student")):
        which = f"--stage {options.stage}" if recipe.model.distils else f"{options.method or options.recipe}"
        raise SettingsError(f"train: {which} is trained without a teacher; leave out --teacher")
    stages: list[Stage] = ["teacher", "student"] if options.stage == "all" else [options.stage]
    if options.stage == "all" and (options.teacher or not recipe.model.distils):
        stages = ["student"]
    path = options.out
    for stage in stages:
        teacher = options.teacher
        if stage == "student" and teacher is None and recipe.model.distils:
            teacher = options.out / "teacher" / DETECTOR
        path = train(
            recipe,
            options.data,
            options.out / stage,
            stage,
            teacher=teacher,
            validate=options.validate,
            seed=options.seed,
            init=options.init,
            devices=options.devices,
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

    The run folder holds

    * `settings.json`: recipe, seed, versions, hashes of the data, of the teacher and of the start,
    * `environment.json`: the machine and its libraries, one more entry for each start on another,
    * `metrics.csv`: one row per epoch, and `curves.png`, its plot; `tensorboard/` where that is installed. Average
      precisions are called `val/...` on validation frames, `train/...` where none are held out,
    * `checkpoints/last.ckpt` to resume from and, where a recipe keeps the best weights, `checkpoints/best.pt`,
    * `detector.pt` for use, and `result.json`: its hash and average precision, which `dsrc model verify` compares.

    Several devices, or `torchrun`'s processes, share each batch and average their gradients: a step is that of one
    device, except for batch-wide statistics. Batch norms take theirs from a device's own share (the running ones,
    which a detector uses, are those of the first device), and the distillation and reconstruction losses, means over
    foreground, are averaged by device and not by cell.

    Args:
        stage: `teacher` reads clouds made with ground truth; `student` is the recipe's model; `plain` is the student
            without distillation and reconstruction.
        teacher: detector file of a teacher, for a student that distils.
        validate: folder of validation drives; None holds out the end of each training drive. With a drive that is
            trained on among them, metrics are called those of training frames.
        resume: continue from the run folder's last checkpoint if there is one; a run interrupted and resumed ends with
            the weights of an uninterrupted one. A finished one stays as it is, except for `environment.json`.
        seed: seed of weights, order and augmentation.
        init: detector file to start from: weights that match by name and shape are taken, and counted in the record.
        devices: GPUs, or processes without a GPU, that train together on this machine; `torchrun` brings its own
            number.

    Returns:
        The detector file.

    Raises:
        DataError: the data is missing or wrong, or another process trains in the folder.
        CheckpointError: the teacher or the start is missing or does not fit, or the checkpoint is damaged.
        SettingsError: the run to resume was started with other settings, data, teacher or start; the recipe needs
            validation frames and there are none; the batch cannot be shared among the devices.
        TrainingAlarm: the loss became NaN, or nothing is ever detected.
    """
    keep_memory()
    settings = recipe.settings(stage)
    taught_by = load_teacher(teacher, settings) if stage == "student" and settings.distils else None
    drives, validation = list_drives(data), None if validate is None else list_drives(validate)
    processes = Processes.of(recipe, devices)
    loaders = DetectionData(recipe, settings, drives, validation, seed)
    _check_frames(recipe, loaders, processes.count)
    check_folder(out)
    out.mkdir(parents=True, exist_ok=True)

    with torch.random.fork_rng():
        torch.manual_seed(seed)
        detector = Detector(settings)
        module = DetectionModule(recipe, detector, taught_by, seed, validates_on_unseen=loaders.validates_on_unseen)
    record = {
        **provenance({"recipe": msgspec.to_builtins(recipe), "stage": stage}, seed, drive_hashes(drives)),
        "validation": None if validation is None else drive_hashes(validation),
        "teacher": None if teacher is None or taught_by is None else file_sha256(teacher),
        "init": None if init is None else initialise_from(init, module.detector),
        "devices": processes.count,
    }

    folder = RunFolder(out)
    with locked(out, what="training") if leads() else nullcontext():
        state = folder.state(record) if resume else "new"
        if state == "finished":
            if leads():
                folder.note_environment(processes.count)
            return folder.detector

        if not loaders.validates_on_unseen and leads():
            why = "no frame is held out" if validate is None else "a drive of the validation is trained on"
            LOG.warning("%s: %s: average precisions are those on training frames, train/ap_...", out, why)
        selection = WeightSelection(recipe, folder.best)
        with _without_advice(), half_products(recipe.bfloat16):
            trainer = _trainer(recipe, folder, processes, [selection, *callbacks])
            if trainer.is_global_zero:
                folders = {"data": str(data.resolve()), "validate": validate and str(validate.resolve())}
                folder.start({**record, "folders": folders}, anew=state == "new")
                folder.note_environment(processes.count)
            try:
                trainer.fit(module, loaders, ckpt_path=str(folder.last) if state == "interrupted" else None)
            except UserError as error:
                raise _without_traceback(error) from None
        if trainer.interrupted:
            raise KeyboardInterrupt
        if trainer.is_global_zero:
            _finish(folder, module.detector, selection, loaders, record, recipe.half)
        trainer.strategy.barrier()  # the next stage of every process reads the file
        return folder.detector


def _finish(
    folder: RunFolder,
    trained: Detector,
    selection: WeightSelection,
    loaders: DetectionData,
    record: dict[str, object],
    half: bool,
) -> None:
    """Write the detector, and the result that its file has on the validation frames."""
    # The detector may be there, of the recorded run: it can be interrupted while its result is computed.
    if not folder.detector.exists():
        selection.apply(trained)
        meta = {**record, "epoch": selection.epoch, "metrics": selection.metrics}
        save_detector(folder.detector, trained, meta, half=half)
    detector = load_detector(folder.detector, best_device())
    metrics = validate_detector(detector, loaders.validation_batches(), loaders.validates_on_unseen)
    sha256 = file_sha256(folder.detector)
    write_json(folder.result, {"detector": sha256, "epoch": selection.epoch, "metrics": metrics})


def leads() -> bool:
    """Return whether this process is the first, or the only one, of those that share a training."""
    return not getattr(rank_zero_only, "rank", None)


@dataclass(frozen=True, slots=True)
class Processes:
    """Processes that train together: `per_node` on each of `nodes` machines."""

    per_node: int
    nodes: int

    @property
    def count(self) -> int:
        """Number of processes on all machines."""
        return self.per_node * self.nodes

    @classmethod
    def of(cls, recipe: Recipe, devices: int) -> "Processes":
        """Return the processes of `torchrun`, or else as many as `devices` on this machine.

        Raises:
            SettingsError: there are not as many GPUs, or the recipe's batch cannot be shared among the processes.
        """
        processes = cls(devices, 1)
        if "TORCHELASTIC_RUN_ID" in os.environ:
            processes = cls(int(os.environ["LOCAL_WORLD_SIZE"]), int(os.environ["GROUP_WORLD_SIZE"]))
        per_node, count = processes.per_node, processes.count
        if per_node < 1:
            raise SettingsError(complaint("train", "devices", "at least 1", per_node))
        if torch.cuda.is_available() and per_node > torch.cuda.device_count():
            raise SettingsError(complaint("train", "devices", f"at most {torch.cuda.device_count()} GPUs", per_node))
        if recipe.batch_size % count:
            raise SettingsError(
                complaint("recipe", "batch_size", f"a multiple of the {count} devices", recipe.batch_size)
            )
        return processes


def _check_frames(recipe: Recipe, loaders: DetectionData, devices: int) -> None:
    """Require a training frame for each device, and unseen validation frames where validations decide."""
    frames = min(len(loaders.training), recipe.epoch_frames or len(loaders.training))
    if frames < devices:
        raise SettingsError(complaint("recipe", "epoch_frames", f"at least one for each of {devices} devices", frames))
    field = validations_decide(recipe.keep, recipe.patience)
    if field and not loaders.validates_on_unseen:
        hint = "; give validation drives or a validation_share"
        raise SettingsError(complaint("recipe", field, "frames that are not trained on, to choose by", "none", hint))


def _without_traceback(error: UserError) -> UserError:
    """Return the error of a process that prepares batches: PyTorch hands it on as the text of its traceback."""
    text = str(error)
    if not text.startswith("Caught "):
        return error
    _, _, message = text.rstrip().rpartition("\n")[2].partition(": ")
    return type(error)(message)


@contextmanager
def _without_advice() -> Iterator[None]:
    """Silence Lightning's advice: workers and log steps are the recipe's choice, the rest is its own inside."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", PossibleUserWarning)
        warnings.filterwarnings("ignore", message=".*LeafSpec")
        warnings.filterwarnings("ignore", message="Checkpoint directory .* exists and is not empty")
        yield


def _trainer(recipe: Recipe, folder: RunFolder, processes: Processes, callbacks: Sequence[pl.Callback]) -> pl.Trainer:
    last = ModelCheckpoint(
        folder.checkpoints,
        filename=folder.last.stem,
        save_top_k=1,
        enable_version_counter=False,
        save_on_train_epoch_end=True,
    )
    bar = [RichProgressBar()] if sys.stderr.isatty() else []
    try:
        logger: TensorBoardLogger | bool = TensorBoardLogger(folder.path, name="tensorboard", version="")
    except ModuleNotFoundError:
        logger = False
    return pl.Trainer(
        max_epochs=recipe.epochs,
        accelerator="auto",
        devices=processes.per_node,
        num_nodes=processes.nodes,
        # Not every step of every method uses every weight: alone, an ego has nothing to fuse.
        strategy="ddp_find_unused_parameters_true" if processes.count > 1 else "auto",
        use_distributed_sampler=False,
        logger=logger,
        callbacks=[ValidationSchedule(recipe.validate_every), MetricsFile(folder.path), last, *bar, *callbacks],
        gradient_clip_val=recipe.clip,
        num_sanity_val_steps=0,
        log_every_n_steps=10,
        enable_progress_bar=bool(bar),
        enable_model_summary=False,
        default_root_dir=folder.path,
    )
