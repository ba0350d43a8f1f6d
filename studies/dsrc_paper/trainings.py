"""Plan of the campaign: every training of report.md, what it starts from and is taught by, in order.

`studies/dsrc_paper/campaign.py` runs it.

Usage:
    python -m studies.dsrc_paper.trainings
"""

import argparse
from dataclasses import dataclass
from pathlib import Path

FIRST, TEACHER, MAP_START = "first", "teacher", "map-start"
SEEDS = 5
LONG, SHORT, JOINT = 4000, 1000, 3000
"""Steps of a student of single clouds, of one with collaborators after it, and of a teacher with collaborators."""
SLOW = ("learning_rate=5e-4", "ema=0.998")
FADING = ("distill.fade=0.3",)


@dataclass(frozen=True)
class Training:
    """Training of the campaign, with its run folder.

    Attributes:
        name: name of the folder.
        phase: phase of the campaign.
        method: see `dsrc model train --method`.
        init: training whose detector it starts from; "" without one.
        seed: seed of weights, order and augmentation.
        steps: number of steps of two frames.
        settings: changes of the recipe.
        teacher: training whose detector is the teacher; "" without one.
        stage: `plain` for the first, else `teacher` or `student`.
        passes: passes over all frames, in place of steps.
        data: name of the data set of its drives, in a folder beside that of the campaign; "" for the campaign's.
    """

    name: str
    phase: int
    method: str
    init: str = ""
    seed: int = 0
    steps: int = SHORT
    settings: tuple[str, ...] = SLOW
    teacher: str = ""
    stage: str = "student"
    passes: int = 0
    data: str = ""

    def folder(self, out: Path) -> Path:
        """Return its run folder."""
        return out / self.name / self.stage

    def detector(self, out: Path) -> Path:
        """Return its detector file."""
        return self.folder(out) / "detector.pt"

    def needs(self) -> tuple[str, ...]:
        """Return the trainings that it depends on."""
        return tuple(name for name in (self.init, self.teacher) if name)


def campaign(seeds: int = SEEDS, weights: float = 1.0) -> list[Training]:
    """Return all trainings, in the order in which they run: seeds 0 and 1 by phase, further seeds, the parts of DSRC.

    Every comparison so has two seeds before any has more, and the parts, the dearest table, come when the whole is
    known. All students start from the teacher's weights: one with features of another origin would have to unlearn
    them. A plain student starts where its distilled twin does.

    Args:
        seeds: seeds of DSRC and of its plain twin.
        weights: factor of the distillation weights, decided by the gates.
    """
    long = ("learning_rate=1e-3", "ema=0.998")
    halved = "" if weights == 1.0 else "-halved"
    scaled = () if weights == 1.0 else tuple(f"distill.{part}={weights * full}" for part, full in WEIGHTS.items())
    fading = (*FADING, *scaled)

    def twins(seed: int) -> tuple[Training, Training]:
        single, distilled = f"single_s{seed}", f"dsrc-single{halved}_s{seed}"
        return (
            Training(single, 2, "no-collaboration", TEACHER, seed, LONG, long),
            Training(distilled, 2, "dsrc-alone", TEACHER, seed, LONG, (*long, *fading), TEACHER),
        )

    # Attention has no weights, but a teacher of single clouds alone hardly scores what only collaborators see: 0.21 on
    # validation, 0.25 after 1,000 steps with collaborators, see `G0-*` of the gates' record.
    alone = f"{TEACHER}-alone"
    teachers = (
        Training(alone, 1, "dsrc-alone", FIRST, 1, 0, ("ema=0.998",), stage="teacher", passes=3),
        Training(TEACHER, 1, "dsrc", alone, 2, JOINT, long, stage="teacher"),
    )

    def student(name: str, phase: int, method: str, seed: int = 0, *settings: str) -> Training:
        taught = method.startswith("dsrc")
        init = f"dsrc-single{halved}_s{seed}" if taught else f"single_s{seed}"
        more = (*fading, *settings) if taught else settings
        return Training(name, phase, method, init, seed, SHORT, (*SLOW, *more), TEACHER if taught else "")

    parts = {"sdd": ("pcp=false", "rec=false"), "pcp": ("sdd=false", "rec=false"), "sdd-pcp": ("rec=false",)}
    of_parts = {"sdd": "teacher-sdd", "pcp": "teacher-pcp", "sdd-pcp": TEACHER}
    few, two = min(seeds, 3), min(seeds, 2)
    planned = [
        Training(FIRST, 1, "no-collaboration", settings=(), stage="plain", passes=2),
        *teachers,
        *(training for seed in range(seeds) for training in twins(seed)),
        *(student(f"{m}_s{seed}", 3, m, seed) for seed in range(seeds) for m in ("dsrc", "attfuse")),
        *(student(f"where2comm_s{seed}", 3, "where2comm", seed) for seed in range(few)),
        *(student(f"{m}_s0", 3, m) for m in ("f-cooper", "dsrc-max", "no-collaboration", "dsrc-alone")),
        *(student(f"{m}_s0", 3, m) for m in ("early", "late")),
        # The whole teacher, used to what it no longer gets: paint, or dense clouds.
        *(
            Training(of_parts[name], 4, "dsrc", TEACHER, 2, settings=(*SLOW, *parts[name]), stage="teacher")
            for name in ("sdd", "pcp")
        ),
        *(
            training
            for name, settings in parts.items()
            for seed in range(two)
            for taught in (of_parts[name],)
            for training in (
                Training(
                    f"{name}-single_s{seed}", 4, "dsrc-alone", taught, seed, LONG, (*long, *fading, *settings), taught
                ),
                Training(
                    f"{name}_s{seed}",
                    4,
                    "dsrc",
                    f"{name}-single_s{seed}",
                    seed,
                    SHORT,
                    (*SLOW, *fading, *settings),
                    taught,
                ),
            )
        ),
        # In the shape of the methods that fuse one map; with CoAlign's backbone. Others have all layers of their start.
        # Its own layers start from nothing: after 1,000 steps at half the rate AP@0.7 was 22, that of single_s0 is 38.
        Training(MAP_START, 5, "max-map", "single_s0", 0, LONG, (*long, "max_agents=1")),
        Training("coalign-start", 5, "no-collaboration", TEACHER, 0, LONG, (*long, "backbone=resnet")),
        # Beside the maximum itself, trained as long: what the four add to their start.
        *(Training(f"{m}_s0", 5, m, MAP_START) for m in ("max-map", "v2vnet", "v2x-vit", "cobevt", "ermvp")),
        Training("mrcnet-style_s0", 5, "mrcnet-style", "single_s0"),
        Training("coalign_s0", 5, "coalign", "coalign-start"),
        *(
            student(f"dsrc-{name}_s{seed}", 6, "dsrc", seed, *settings)
            for name, settings in FURTHER.items()
            for seed in range(two)
        ),
        # What corruption teaches without distillation.
        *(student(f"attfuse-corrupted_s{seed}", 6, "attfuse", seed, *FURTHER["corrupted"]) for seed in range(two)),
        # Encoder and backbone of the vehicles' network: from random weights 500 steps learn nothing but the prior.
        Training(
            ALONE,
            6,
            "no-collaboration",
            "single_s0",
            steps=3_000,
            settings=(*long, *VULNERABLE),
            data=PEDESTRIANS,
        ),
        Training("vulnerable", 6, "attfuse", ALONE, steps=1_500, settings=(*SLOW, *VULNERABLE), data=PEDESTRIANS),
    ]
    return sorted(
        planned, key=lambda training: (training.phase == 4, training.stage == "student" and training.seed > 1)
    )


WEIGHTS = {"dae": 1.0, "daf": 1.0, "dap": 0.5}
"""Distillation weights, see `DistillSettings`."""
FURTHER = {
    "thinned": ("augmentation.thinning=0.5",),
    "corrupted": ("augmentation.corruption=0.5",),
    "consistent": ("augmentation.corruption=0.5", "consistency=0.5"),
    "directed": ("direction=true",),
    "lifted": ("augmentation.height_m=0.4",),
}
"""Extensions of the paper, as changes of the recipe by name."""
ALONE = "vulnerable-alone"
PEDESTRIANS = "dsrc-sim-vulnerable"
"""Data set with more of them: dsrc-sim has half a pedestrian a frame for training, and nearly none for validation."""
VULNERABLE = (
    "users=vulnerable",
    'grid={"range_m":[-38.4,-25.6,-3,38.4,25.6,1],"cell_m":0.2}',
    "decoder_channels=32",
    "shrink_channels=64",
)
"""Network for pedestrians and two-wheelers, on a grid as fine as they are small; narrow, since that grid has three
times the cells of the vehicles', whose network the closed loop runs beside it."""


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    ).parse_args()
    line = "{:5} {:26} {:17} {:5} {:26} {:13} {}"
    print(line.format("phase", "training", "method", "steps", "starts from", "teacher", "data").rstrip())
    for one in campaign():
        steps = f"{one.passes} x" if one.passes else one.steps
        init, teacher = one.init or "-", one.teacher or "-"
        print(line.format(one.phase, one.name, one.method, steps, init, teacher, one.data).rstrip())
    print("steps are of two frames; x: passes over all frames; data: that of the campaign where none is named")


if __name__ == "__main__":
    main()
