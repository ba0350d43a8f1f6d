"""Options of commands around detectors: `dsrc evaluate`, `benchmark` and `model train`."""

from pathlib import Path
from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from tyro.conf import Positional, arg

from dsrc.options.fields import (
    CHANNELS,
    CORRUPTIONS,
    METHODS,
    RECIPES,
    AgentsText,
    Data,
    Disturbed,
    Family,
    FaultTexts,
    File,
    Folder,
    choice,
)
from dsrc.options.told import MESSAGES, NO_DEFENCE, SINGLE_DEFENCES

Checkpoint = Annotated[str, arg(metavar="[NAME=]DETECTOR")]
"""A detector file, `FILE.onnx`, `module:Class`, `pipe:COMMAND ...` or `tcp://localhost:PORT`, see `dsrc.detectors`."""
Checkpoints = Annotated[tuple[str, ...], arg(metavar="[NAME=]DETECTOR [...]")]
Kinds = Annotated[tuple[str, ...], choice(("clean", "paper_six", "all", *CORRUPTIONS), several=True)]
Engine = Literal["fused", "bf16", "compiled", "plain"]
AutoEngine = Literal["auto", "fused", "bf16", "compiled", "plain"]
Device = Literal["cpu", "cuda"]
Height = Annotated[str, arg(metavar="{recorded,auto,METRES}")]
"""Ground under the clouds, see `dsrc.detectors.levelled`."""
Messages = Annotated[tuple[str, ...], choice(MESSAGES, several=True)]
DefenceTexts = Annotated[tuple[str, ...], choice((NO_DEFENCE, *SINGLE_DEFENCES), several=True)]
Channels = Annotated[tuple[str, ...], choice(CHANNELS, several=True)]
PROTOCOLS = (
    "opencood",
    "opencood-global",
    "opencood-no-ego",
    "opencood-global-no-ego",
    "v2v4real",
    "coalign",
    "coalign-v2x-vit",
    "coalign-dair",
    "dair-vic",
    "kitti-r11",
    "kitti-r40",
    "kitti-easy-r11",
    "kitti-moderate-r11",
    "kitti-hard-r11",
    "kitti-easy-r40",
    "kitti-moderate-r40",
    "kitti-hard-r40",
    "testbed",
    "testbed-per-frame",
)
"""Names for the help text; `dsrc.evaluation.metrics.protocols` decides, a test compares."""


class Evaluation(Disturbed, frozen=True, kw_only=True):
    """Options of an evaluation.

    Attributes:
        checkpoint: detectors: files, ONNX files, module:Class, pipe:COMMAND or tcp://localhost:PORT; NAME= names a row.
        data: a drive, or a folder of drives.
        out: folder of results.csv, results.json, plots and cached cells with all detections, which dsrc view opens; an
            interrupted evaluation resumes.
        corruption: kinds of corruption; paper_six are those of the paper's tables; clean frames are always evaluated.
        fault: faults, each text a condition of its own: a corruption with its severity, or what else is wrong with
            sensors, poses and radio, with its numbers and agents, as in 'fog:3 on helpers + loss:0.3'; default: none.
        seed: seed of corruptions and channels.
        frames: frames to evaluate, evenly spread; default: all.
        ego_alone: also evaluate the first detector without collaborators.
        messages: also evaluate the first detector with helpers that each detect alone and tell all their boxes, or as
            ETSI's Collective Perception Messages, less what others tell; default: none.
        defence: also evaluate what tells boxes with a defence against helpers that lie, faults ghost, remove and
            false_pose: one of these, or both between commas; default: none.
        channel: radio channels, each detector through each of them; default: no loss and no delay.
        height: ground under the clouds, see dsrc detect.
        drop_lone_points: each agent drops points with few neighbours, as flakes in the air are.
        engine: execution of the networks: fused layers, the same in half precision for CPUs with AMX, PyTorch's
            compiler, or layer by layer.
        device: device of the networks.
        reuse: folders of earlier evaluations: cells whose settings agree in all but code and package versions are
            taken from them, which is recorded; default: none.
    """

    checkpoint: Checkpoints
    data: Data
    out: Folder
    corruption: Kinds = ("paper_six",)
    fault: FaultTexts = ()
    seed: int = 0
    frames: int | None = None
    ego_alone: bool = True
    messages: Messages = ()
    defence: DefenceTexts = ()
    channel: Channels = ()
    height: Height = "recorded"
    drop_lone_points: bool = False
    engine: Engine = "fused"
    device: Device = "cpu"
    reuse: tuple[Folder, ...] = ()


class Detection(msgspec.Struct, frozen=True, kw_only=True):
    """Options of detections in drives.

    Attributes:
        checkpoint: detector, see dsrc evaluate.
        data: a drive, or a folder of drives.
        out: folder of boxes.json, which dsrc score reads, and of cached cells, with which dsrc view shows the boxes; an
            interrupted run resumes.
        format: further forms of the boxes: kitti for labels with scores, opencood for 0000_pred.npy; default: none.
        height: ground under the clouds: recorded leaves them as they are, auto levels them by a ground fitted to each
            cloud, and a number is the height of the LiDAR above flat ground, m.
        ego_only: give the ego's cloud alone.
        score: score the boxes by the drives' ground truth, all together and by source: AP, recall, false boxes a frame,
            error of height; a table and sources.json.
        frames: frames to detect in, evenly spread; default: all.
        engine: execution of the network, see dsrc drive.
        device: device of the network.
    """

    checkpoint: Checkpoint
    data: Data
    out: Folder
    format: tuple[Literal["kitti", "opencood"], ...] = ()
    height: Height = "recorded"
    ego_only: bool = False
    score: bool = False
    frames: int | None = None
    engine: AutoEngine = "auto"
    device: Device = "cpu"


class Stressing(msgspec.Struct, frozen=True, kw_only=True):
    """Options of a stress test.

    Attributes:
        detector: detector, as --checkpoint of dsrc evaluate takes it.
        data: a drive, or a folder of drives; default: the demo's test drive, generated beside the results.
        out: folder of tables, curves, the worst frames and cached cells, which dsrc view opens; an interrupted test
            resumes.
        corruption: kinds of corruption.
        severity: severities of each, 1 to 5.
        corrupted_agents: groups of agents whose sweeps are corrupted, each by itself.
        family: models of the corruptions.
        fault: faults, each text a condition of its own: a corruption with its severity, or what else is wrong with
            sensors, poses and radio, with its numbers and agents, as in 'fog:3 on helpers + loss:0.3'; default: none.
        messages: helpers detect alone and tell boxes, see dsrc evaluate; default: what the detector shares.
        defence: of a detector that tells boxes, see dsrc evaluate.
        share: share of the clean average precision below which a severity is critical.
        quick: 12 frames and severities 1, 3 and 5.
        frames: frames to evaluate, evenly spread; default: all.
        height: ground under the clouds, see dsrc detect.
        seed: seed of the corruptions.
        engine: execution of the network, see dsrc evaluate.
        device: device of the network.
    """

    detector: Positional[Annotated[str, arg(metavar="DETECTOR")]]
    data: Positional[Annotated[Path | None, arg(metavar="DATA")]] = None
    out: Folder = Path("stress")
    corruption: Kinds = ("all",)
    severity: tuple[int, ...] = (1, 2, 3, 4, 5)
    corrupted_agents: Annotated[tuple[str, ...], Meta(min_length=1)] = ("all", "ego", "helpers")
    family: Family = "physical"
    fault: FaultTexts = ()
    messages: Annotated[str | None, choice(MESSAGES)] = None
    defence: Annotated[str, choice((NO_DEFENCE, *SINGLE_DEFENCES))] = "none"
    share: float = 0.5
    quick: bool = False
    frames: int | None = None
    height: Height = "recorded"
    seed: int = 0
    engine: Engine = "fused"
    device: Device = "cpu"


class Sharing(Disturbed, frozen=True, kw_only=True):
    """Options of the shares of agents in detections.

    Attributes:
        checkpoint: detector, see dsrc evaluate.
        data: a drive, or a folder of drives.
        out: folder of shares.csv, shares.json, shares.png and cached cells; an interrupted run resumes.
        corruption: kinds of corruption beside clean frames; paper_six are those of the paper's tables; default: none.
        channel: radio channel; default: no loss and no delay.
        iou: least overlap in bird's-eye view of a detection with the box that it is of.
        seed: seed of corruptions and channel.
        frames: frames to look at, evenly spread; default: all.
        engine: execution of the network, see dsrc evaluate.
        device: device of the network.
        reuse: folders of earlier shares: cells whose settings agree in all but code and package versions are taken
            from them, which is recorded; default: none.
    """

    checkpoint: Checkpoint
    data: Data
    out: Folder
    corruption: Kinds = ()
    channel: Annotated[str | None, choice(CHANNELS)] = None
    iou: float = 0.5
    seed: int = 0
    frames: int | None = None
    engine: Engine = "fused"
    device: Device = "cpu"
    reuse: tuple[Folder, ...] = ()


class Scoring(msgspec.Struct, frozen=True, kw_only=True):
    """Options of scores under published protocols.

    Attributes:
        detections: results of dsrc evaluate or benchmark, a JSON file, a folder of KITTI's labels with scores, or
            OpenCOOD's 0000_pred.npy.
        truth: tree of the true boxes: OPV2V, V2V4Real, DAIR-V2X-C or KITTI; default: those stored with the detections.
        protocol: published protocols.
        score_threshold: least score of the boxes that count; default: all.
        corruption: corruption of stored results.
    """

    detections: Positional[Annotated[Path, arg(metavar="DETECTIONS")]]
    truth: Folder | None = None
    protocol: Annotated[tuple[str, ...], choice(("all", *PROTOCOLS), several=True)] = ("all",)
    score_threshold: float | None = None
    corruption: Annotated[str, choice(("clean", "all", *CORRUPTIONS))] = "clean"


class Comparison(msgspec.Struct, frozen=True, kw_only=True):
    """What methods are compared under: fields of a benchmark's TOML and options of `dsrc benchmark`.

    Attributes:
        corruption: kinds of corruption; paper_six are those of the paper's tables; clean frames are always evaluated.
        severity: severities of each corruption, 1 to 5; the tables show 3, the paper's, where it is among them.
        family: models of the corruptions: of physical causes, or as published in papers; tables of each.
        corrupted_agents: agents whose sweeps are corrupted, by word or by their ids; weather at some alone is a
            counterfactual: it acts on their sensors and nowhere else.
        fault: faults, each text a condition of its own: a corruption with its severity, or what else is wrong with
            sensors, poses and radio, with its numbers and agents, as in 'fog:3 on helpers + loss:0.3'; default: none.
        channel: radio channels; the tables show ideal, where every message arrives and bytes are counted.
        frames: frames of each dataset to evaluate, evenly spread; default: all.
        seed: seed of corruptions and channels.
    """

    corruption: Kinds = ("paper_six",)
    severity: tuple[int, ...] = (3,)
    family: Annotated[tuple[Family, ...], Meta(min_length=1)] = ("physical",)
    corrupted_agents: AgentsText = "all"
    fault: FaultTexts = ()
    channel: Annotated[Channels, Meta(min_length=1)] = ("ideal",)
    frames: int | None = None
    seed: int = 0


class BenchmarkOptions(Comparison, frozen=True, kw_only=True):
    """Options that describe a benchmark, in place of a TOML.

    Attributes:
        plan: TOML of the benchmark, in place of the options that describe one; default: the options.
        checkpoint: detectors, see dsrc evaluate; NAME= names a method, several of one NAME are its trainings;
            default: none.
        data: folders of drives, a dataset each; NAME=FOLDER names one; default: none.
        agents: numbers of agents to compare, such as 1 2 3 4 5; default: none.
        pose_error: pose errors of the collaborators to compare, m and deg, such as 0.2 0.4; default: none.
        delay_s: delays to compare, s; default: none.
        loss: packet loss rates to compare; default: none.
    """

    plan: Positional[File | None] = None
    checkpoint: Checkpoints = ()
    data: Annotated[tuple[str, ...], arg(metavar="[NAME=]FOLDER [...]")] = ()
    agents: tuple[int, ...] = ()
    pose_error: tuple[float, ...] = ()
    delay_s: tuple[float, ...] = ()
    loss: tuple[float, ...] = ()


class TrainOptions(msgspec.Struct, frozen=True):
    """Options of a training.

    Attributes:
        recipe: settings of model and training; dsrc-paper is DSRC as its text says, dsrc-code as released.
        data: folder of the training drives.
        out: run folder, with one subfolder per stage.
        stage: all is teacher, then student; plain is the student without teacher and reconstruction.
        teacher: detector file of a trained teacher, for the student; default: the one in the run folder.
        validate: folder of the validation drives; default: the end of each training drive.
        seed: seed of weights, order and augmentation.
        epochs: number of epochs; default: the recipe's.
        method: collaboration method; default: the recipe's.
        init: detector file to start from, by weights whose name and shape agree; default: random weights.
        devices: GPUs, or processes without one, that share each batch; torchrun sets its own number.
        set: settings of the model, of the recipe or of a part of it, such as sdd=false fusion=max
            augmentation.corruption=0.5; default: the recipe's.
    """

    recipe: Positional[Annotated[str, choice(RECIPES)]]
    data: Folder
    out: Folder
    stage: Literal["all", "teacher", "student", "plain"] = "all"
    teacher: File | None = None
    validate: Folder | None = None
    seed: int = 0
    epochs: int | None = None
    method: Annotated[str | None, choice(METHODS)] = None
    init: File | None = None
    devices: int = 1
    set: Annotated[tuple[str, ...], arg(metavar="FIELD=VALUE [...]")] = ()
