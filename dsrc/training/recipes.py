"""Recipes: settings of a training, and the presets and methods of the comparison."""

from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta
from msgspec.structs import replace

from dsrc.models.inputs.labels import LabelSettings, released_labels
from dsrc.models.settings import Count, ModelSettings
from dsrc.ops.grid import GridSpec
from dsrc.training.losses import DistillSettings, released
from sensors.corruptions import CORRUPTIONS, PAPER_SIX
from sim.errors import SettingsError, complaint, did_you_mean, one_line
from sim.settings import convert

Stage = Literal["teacher", "student", "plain"]
PARTS = ("model", "distill", "labels", "augmentation")
"""Fields of a recipe that are structs themselves."""
NotNegative = Annotated[float, Meta(ge=0)]


class Augmentation(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Augmentation of training samples, drawn anew each time; clouds, boxes and all agents move together.

    Attributes:
        flip: mirror left and right, and front and back, each with probability one half.
        rotation_deg: largest rotation about the vertical axis, degrees.
        scale: largest relative change of size in the plane.
        height_m: largest shift along the vertical axis, m, as if the ego's LiDAR stood higher or lower.
        sizes: largest relative change of the size of each vehicle, half of it upwards: the factor of a vehicle is drawn
            from 1 - sizes to 1 + sizes / 2, with up to a quarter of `sizes` more or less for the length. No vehicle
            shrinks below a length of 2.2 m, and none grows into another. Its points move with it; people and
            two-wheelers keep their sizes. Source: random object scaling of J. Yang et al., ST3D, CVPR 2021.
        crowding: probability that a vehicle is put a second time, right beside what stands, in samples of which the ego
            takes part alone; needs heights above the ground. See `dsrc.training.augmentation.crowding`.
        intensity: probability that a sample has intensities as of sensors of other makers: in half of these samples
            each agent's are raised to a power from 0.6 to 1.6 and multiplied by 1/4 to 4, at most 1; in the other half
            all are one value from 0 to 0.4, as of sensors without intensities, for which readers put 0 or 0.2.
        random_ego: any of the frame's vehicles is the ego, not always the first.
        dropout: probability that only some agents (one to all, evenly) take part, with the ground truth that these have
            seen. One network so learns to detect alone and with collaborators.
        alone: probability that the ego takes part alone, with the ground truth that it has seen: 1 is for a network of
            single vehicles, which else learns to find what only others see.
        thinning: probability that a student gets a random share of each agent's points. Ground truth, teacher clouds
            and reconstruction target keep all of them, so that distillation is sparse to dense beyond the views.
        corruption: probability that the sensors of a sample are corrupted, by any of `kinds` in any severity. Ground
            truth, teacher clouds and reconstruction target are those of the clean sample.
        kinds: corruptions of the physical family. The default are those of the paper's tables: results under them are
            then of a network trained on them, and have to be declared so.
    """

    flip: bool = True
    rotation_deg: Annotated[float, Meta(ge=0, le=180)] = 15.0
    scale: Annotated[float, Meta(ge=0, le=0.5)] = 0.05
    height_m: Annotated[float, Meta(ge=0, le=1)] = 0.0
    sizes: Annotated[float, Meta(ge=0, le=0.5)] = 0.0
    crowding: Annotated[float, Meta(ge=0, le=1)] = 0.0
    intensity: Annotated[float, Meta(ge=0, le=1)] = 0.0
    random_ego: bool = True
    dropout: Annotated[float, Meta(ge=0, le=1)] = 0.3
    alone: Annotated[float, Meta(ge=0, le=1)] = 0.0
    thinning: Annotated[float, Meta(ge=0, le=1)] = 0.0
    corruption: Annotated[float, Meta(ge=0, le=1)] = 0.0
    kinds: tuple[str, ...] = PAPER_SIX

    def __post_init__(self) -> None:
        known = [kind for kind, corruption in CORRUPTIONS.items() if not corruption.spares_ego]
        for kind in self.kinds:
            if kind not in known:
                # Errors of pose and clock move whole clouds and do not corrupt a sensor.
                raise ValueError(f"kinds: expected any of {', '.join(known)}, found '{kind}'")
        if self.corruption and not self.kinds:
            raise ValueError("kinds: expected at least one, found none")


class Recipe(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Recipe of a training: all its settings but data and seed.

    Attributes:
        name: key in `RECIPES`.
        model: the student's settings.
        distill: weights and forms of the distillation.
        labels: rules by which targets are made of the ground truth.
        reconstruction: weight of the reconstruction losses.
        reconstruction_window: share of the map's width and height that a step reconstructs, at a random place; 1 is all
            of it, which takes a third of a step's time; 0.5 takes a quarter of that.
        direction: weight of the direction loss, where the model has that head; PointPillars' by default.
        consistency: weight of the loss between the predictions in a sample's corrupted and clean view; the other losses
            then use the clean one. With 0 there is no clean view of a corrupted sample.
        augmentation: changes of the training samples.
        epochs: passes over the data, or over draws of `epoch_frames` from it.
        epoch_frames: frames per epoch, drawn anew for each epoch without replacement; None takes all. Frames a tenth of
            a second apart are much alike.
        batch_size: samples per step, shared among the devices.
        learning_rate: peak learning rate.
        optimizer: `adamw`, or `adam` with the released code's epsilon, 1e-10.
        weight_decay: of AdamW, on weights of convolutions and the linear layer only; of Adam, as a gradient of all.
        schedule: per step, after a linear warm-up: `one_cycle` and `cosine` fall along a half cosine, the first to
            almost nothing, the second to a hundredth of the peak. `released` is the released code's: once per epoch,
            from a fifth of the peak up and to a fiftieth down, on a cosine that began to fall with the training.
        warmup: share of the steps in which the rate rises.
        clip: largest gradient norm; 0 does not clip.
        validate_every: epochs between validations; the last epoch always has one.
        validation_share: without a validation set, this last part of each drive is held out; with 0, the metrics are
            those on training frames, and called so.
        validation_frames: maximum number of validation frames, evenly spread.
        patience: validations in a row without a better AP@0.5 + AP@0.7 that end the training; None never ends it early.
        keep: resulting weights: the `last`, or the `best` by AP@0.5 + AP@0.7 of the validations.
        ema: decay of an exponential moving average of the weights, which validations and the result use; 0 is without.
        alarm_after: validations in a row with an average precision of 0 that end the training.
        workers: processes that prepare batches.
        bfloat16: convolutions and matrix products in bfloat16: with AMX or on a GPU about twice as fast; a CPU without
            it computes the same numbers through float32 from PyTorch 2.9 on, in about the time of float32.
        half: store the weights in half precision.
    """

    name: str
    model: ModelSettings
    distill: DistillSettings = DistillSettings()
    labels: LabelSettings = LabelSettings()
    reconstruction: NotNegative = 1.0
    reconstruction_window: Annotated[float, Meta(gt=0, le=1)] = 1.0
    direction: NotNegative = 0.2
    consistency: NotNegative = 0.0
    augmentation: Augmentation = Augmentation()
    epochs: Count = 40
    epoch_frames: Count | None = None
    batch_size: Count = 2
    learning_rate: Annotated[float, Meta(gt=0, le=10)] = 2e-3
    optimizer: Literal["adamw", "adam"] = "adamw"
    weight_decay: NotNegative = 1e-2
    schedule: Literal["one_cycle", "cosine", "released"] = "one_cycle"
    warmup: Annotated[float, Meta(ge=0, le=1)] = 0.1
    clip: NotNegative = 10.0
    validate_every: Count = 2
    validation_share: Annotated[float, Meta(ge=0, lt=1)] = 0.1
    validation_frames: Count = 40
    patience: Count | None = None
    keep: Literal["last", "best"] = "last"
    ema: Annotated[float, Meta(ge=0, lt=1)] = 0.0
    alarm_after: Count = 3
    workers: Annotated[int, Meta(ge=0)] = 1
    bfloat16: bool = False
    half: bool = True

    def __post_init__(self) -> None:
        if self.labels.targets == "released" and self.model.users != "vehicles":
            # The released rules know one class: either anchor may have every box.
            raise ValueError(f"labels.targets: expected overlap with users={self.model.users}, found released")
        if self.augmentation.crowding and self.model.height != "ground":
            found = f"{self.augmentation.crowding:g} with model.height={self.model.height}"
            raise ValueError(f"augmentation.crowding: expected 0, or model.height=ground, found {found}")

    def settings(self, stage: Stage) -> ModelSettings:
        """Return the settings of a stage's network."""
        if stage == "teacher":
            return replace(self.model, role="teacher", rec=False)
        if stage == "plain":
            return replace(self.model, role="student", sdd=False, pcp=False, rec=False)
        return replace(self.model, role="student")


def opv2v() -> Recipe:
    """Return the recipe with the paper's range, sizes and schedule (Implementation Details); needs a GPU."""
    return Recipe(name="opv2v", model=ModelSettings(), schedule="cosine", validate_every=4, workers=4)


_AS_IT_IS = Augmentation(flip=False, rotation_deg=0.0, scale=0.0, random_ego=False, dropout=0.0)


def dsrc_paper() -> Recipe:
    """Return the recipe of DSRC as in its text, at its range; needs a GPU.

    Of the text (arXiv 2412.10739, Implementation Details and Equations 2 to 9): Adam with a rate of 2e-3 on a cosine
    without a rise, 40 epochs of batches of 2, the epoch that is best in validation, Res2Net blocks 3, 5, 8, weights 1,
    1, 0.5, a foreground of the labelled boxes for the features before the fusion and none for those after it, points in
    the boxes themselves, ten bins of 0.4 m. Augmentation is not mentioned and left out. All else that the text leaves
    open is as in our recipes; `DistillSettings` explains our reading of its sums.
    """
    return Recipe(
        name="dsrc-paper",
        model=ModelSettings(),
        distill=DistillSettings(daf_mask=False),
        labels=LabelSettings(foreground="boxes"),
        augmentation=_AS_IT_IS,
        optimizer="adam",
        weight_decay=1e-4,
        schedule="cosine",
        warmup=0.0,
        keep="best",
        workers=4,
    )


def dsrc_code() -> Recipe:
    """Return the recipe of DSRC as released (github.com/Terry9a/DSRC, 9a6e3d5); needs a GPU.

    Its Res2Net blocks are 3, 4, 5, its rate never reaches the configured 1e-3, its reconstruction has one bin of 4 m of
    ten, its teacher's objects are axis-aligned, its agents are those of the first five folders that are in range, and
    its training changes the frozen teacher's norms. Not reproduced: points are not shuffled before the first 32 of a
    pillar are taken, a reconstructed voxel's mean is of all its points and not of the first 32, and of the features of
    its masks any above zero counts, not one above 0.004.
    """
    model = ModelSettings(
        stage_blocks=(3, 4, 5),
        box_order="hwl",
        padded_slots=True,
        score_prior=None,
        reconstruction_cell_z_m=4.0,
        team_by="folders",
        score_threshold=0.25,
        max_extent_m=6.0,
    )
    return Recipe(
        name="dsrc-code",
        model=model,
        distill=released(),
        labels=released_labels(),
        augmentation=_AS_IT_IS,
        learning_rate=1e-3,
        optimizer="adam",
        weight_decay=1e-4,
        schedule="released",
        warmup=0.25,
        clip=0.0,
        workers=4,
    )


def small() -> Recipe:
    """Return the recipe of 102.4 m x 51.2 m and half the channels, under an hour per stage on two cores."""
    model = ModelSettings(
        # The paper's ceiling of 1 m above the LiDAR would leave out buses and trucks.
        grid=GridSpec(range_m=(-51.2, -25.6, -3.0, 51.2, 25.6, 2.6)),
        pillar_channels=32,
        stage_channels=(32, 64, 128),
        stage_blocks=(2, 2, 2),
        base_width=16,  # splits of 8, 16, 32 channels: whole vectors for a CPU's convolutions
        norm_momentum=0.05,
        decoder_channels=64,
        shrink_channels=128,
        shrink_norm=True,
        reconstruction_channels=(32, 8),
    )
    augmentation = Augmentation(dropout=0.4)
    return Recipe(name="small", model=model, epochs=6, augmentation=augmentation, reconstruction_window=0.5)


def debug() -> Recipe:
    """Return the recipe of a network that overfits four frames in about a minute."""
    model = replace(
        small().model,
        grid=GridSpec(range_m=(-25.6, -12.8, -3.0, 25.6, 12.8, 1.0)),
        pillar_channels=16,
        stage_channels=(16, 32, 64),
        stage_blocks=(1, 1, 1),
        decoder_channels=32,
        shrink_channels=64,
        norm_momentum=0.1,
    )
    return Recipe(
        name="debug",
        model=model,
        augmentation=_AS_IT_IS,
        epochs=60,
        learning_rate=4e-3,
        validate_every=20,
        validation_share=0.0,
        workers=0,
    )


_PLAIN: dict[str, object] = {"sdd": False, "pcp": False, "rec": False}

METHODS: dict[str, dict[str, object]] = {
    "no-collaboration": {"fusion": "none", **_PLAIN},
    "early": {"fusion": "early", **_PLAIN},
    "late": {"fusion": "late", **_PLAIN},
    "f-cooper": {"fusion": "max", **_PLAIN},
    "attfuse": {"fusion": "attention", **_PLAIN},
    "max-map": {"fusion": "max_map", **_PLAIN},
    "v2vnet": {"fusion": "v2vnet", **_PLAIN},
    "v2x-vit": {"fusion": "v2xvit", **_PLAIN},
    "cobevt": {"fusion": "cobevt", **_PLAIN},
    "where2comm": {"fusion": "where2comm", **_PLAIN},
    "coalign": {"fusion": "coalign", **_PLAIN},
    "ermvp": {"fusion": "ermvp", **_PLAIN},
    "mrcnet-style": {"fusion": "mrcnet", **_PLAIN},
    "dsrc": {"fusion": "attention"},
    "dsrc-max": {"fusion": "max"},
    "dsrc-alone": {"fusion": "none"},
}
"""Methods of the comparison, as changes of a recipe's model: range, anchors, widths, thresholds, detection loss and
schedule are the recipe's for all of them."""


def of_method(recipe: Recipe, method: str) -> Recipe:
    """Change a recipe's model to one of `METHODS`.

    Raises:
        SettingsError: the method is unknown.
    """
    if method not in METHODS:
        raise SettingsError(complaint("train", "method", f"one of {', '.join(METHODS)}", method))
    return replace(recipe, model=replace(recipe.model, **METHODS[method]))


RECIPES: dict[str, Callable[[], Recipe]] = {
    "debug": debug,
    "small": small,
    "opv2v": opv2v,
    "dsrc-paper": dsrc_paper,
    "dsrc-code": dsrc_code,
}


def of_today(recipe: Mapping[str, Any]) -> dict[str, Any]:
    """Return a recorded recipe as of this version: the communication range was no setting of the model before."""
    if "comm_range_m" not in recipe:
        return dict(recipe)
    others = {name: value for name, value in recipe.items() if name != "comm_range_m"}
    return {**others, "model": {"comm_range_m": recipe["comm_range_m"], **recipe["model"]}}


def override(recipe: Recipe, overrides: Sequence[str]) -> Recipe:
    """Change a recipe by `field=value` of its model, of itself, or of a part (`augmentation.dropout=0`).

    Raises:
        SettingsError: the field is unknown, the value has another type, or the values do not go together.
    """
    plain = msgspec.to_builtins(recipe)
    parts = {part: getattr(recipe, part).__struct_fields__ for part in PARTS}
    for text in overrides:
        name, _, value = text.partition("=")
        part, _, field = name.rpartition(".")
        if name in parts["model"]:
            part = "model"
        if field not in parts.get(part, Recipe.__struct_fields__ if not part else ()):
            dotted = [f"{part}.{field}" for part, fields in parts.items() if part != "model" for field in fields]
            known = [*parts["model"], *Recipe.__struct_fields__, *dotted]
            raise SettingsError(f"--set {one_line(name, 80)}: no such setting{did_you_mean(name[:80], known)}")
        try:
            parsed = msgspec.json.decode(value)
        except msgspec.DecodeError:
            parsed = value
        except RecursionError:
            raise SettingsError(complaint("--set", name, "a value", "one nested too deeply")) from None
        (plain[part] if part else plain)[field] = parsed
    return convert(plain, Recipe, "--set", SettingsError, strict=False)
