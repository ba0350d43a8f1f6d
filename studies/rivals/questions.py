"""Plans of the trainings of three questions: rivals, parts of DSRC, the paper's scale.

A plan is a generator: what it yields is trained before it goes on, so that later trainings may depend on how earlier
ones ended. It asks by `score`: AP@0.5 + AP@0.7 on the validation drives, clean; NaN of a training that is not finished.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from dsrc.training.recipes import METHODS
from studies.shipped.train import Run

Score = Callable[[str], float]
PLAIN, DSRC = "plain twin", "DSRC"
RIVALS = tuple(name for name in METHODS if name != "attfuse" and not name.startswith("dsrc"))
"""Methods that are compared with DSRC and its plain twin."""
RATES = (5e-4, 1.5e-3)
SEEDS, STRONG_SEEDS, STRONGEST, PART_SEEDS = 5, 3, 4, 3
"""Trainings of DSRC and its twin, and of the strongest rivals; their number; trainings of each part."""
VALIDATED = ("keep=best", "validate_every=2", "validation_frames=140")
"""A validation every 500 steps; the best weights count."""
PLATEAU = (*VALIDATED, "patience=4")
"""Four validations without a better AP@0.5 + AP@0.7 end a training."""
WIDE = (
    *("pillar_channels=64", "stage_channels=[64,128,256]", "base_width=26"),
    *("decoder_channels=128", "shrink_channels=256", "reconstruction_channels=[64,16]"),
)
"""Widths of the recipe `opv2v`, on the range of `small`."""
CHANGES: dict[str, tuple[str, tuple[str, ...]]] = {
    "objects of its own points": ("teacher-sparse", ("sdd=false",)),
    "no painting": ("teacher-unpainted", ("pcp=false",)),
    "no reconstruction": ("teacher", ("rec=false",)),
    "distillation halved": ("teacher", ("distill.dae=0.5", "distill.daf=0.5", "distill.dap=0.25")),
    "distillation doubled": ("teacher", ("distill.dae=2", "distill.daf=2", "distill.dap=1")),
    "distillation fades": ("teacher", ("distill.fade=0.3",)),
    "student thinned more": ("teacher", ("augmentation.thinning=0.6",)),
}
"""Factors of DSRC alone: the teacher that fits, and changes of the recipe; all trainings are thinned with 0.3."""
LENGTHS = {"": 2000, "half as long": 1000, "three times as long": 6000}
SCALE_PARTS = 2


@dataclass(frozen=True)
class Training(Run):
    """Training of a plan.

    Attributes:
        title: method of the tables, of which it is a training; "" for a start, a teacher or a trial.
    """

    title: str = ""


Plan = Callable[[Score], Iterator[Training]]


def rivals(score: Score) -> Iterator[Training]:
    """Yield DSRC, its plain twin and twelve rivals, each with its own rate and length, from the same network.

    The four rivals that are best after their first training have two more, DSRC and its twin four.
    """
    yield from _starts()
    titles, rates = {"attfuse": PLAIN, "dsrc": DSRC} | {name: name for name in RIVALS}, dict[str, float]()
    for method, title in titles.items():
        trials = {f"{method}-rate-{rate:g}": rate for rate in RATES}
        for name, rate in trials.items():
            yield _student(name, method, "", 1000, rate)
        rates[method] = trials[_best(list(trials), score)[0]]
        yield _student(f"{method}-0", method, title, 10_000, rates[method], settings=PLATEAU)
    firsts = {f"{name}-0": name for name in RIVALS}
    strongest = [firsts[name] for name in _best(list(firsts), score)[:STRONGEST]]
    for seed in range(1, SEEDS):
        for method in ("attfuse", "dsrc", *(strongest if seed < STRONG_SEEDS else ())):
            yield _student(f"{method}-{seed}", method, titles[method], 10_000, rates[method], seed, settings=PLATEAU)


def parts(score: Score) -> Iterator[Training]:
    """Yield DSRC with one factor changed each: teacher, painting, reconstruction, weights, length, width, baseline.

    The order of scores needs no training: every benchmark has its Table 1 sorted inside frames, too.
    """
    yield from _starts()
    yield _teacher("teacher-sparse", settings=("sdd=false",))
    yield _teacher("teacher-unpainted", settings=("pcp=false",))
    yield Training("alone-wide", "no-collaboration", "plain", "", 6000, 1.5e-3, settings=(*VALIDATED, *WIDE))
    yield _teacher("teacher-wide", "alone-wide", WIDE)
    for seed in range(PART_SEEDS):
        for method, title in (("attfuse", PLAIN), ("dsrc", DSRC)):
            for length, steps in LENGTHS.items():
                named = ", ".join(filter(None, (title, length)))
                yield _student(f"{method}-{steps}-{seed}", method, named, steps, 1.5e-3, seed)
            name, named = f"{method}-wide-{seed}", f"{title}, wide"
            yield _student(name, method, named, 2000, 1.5e-3, seed, "alone-wide", "teacher-wide", (*VALIDATED, *WIDE))
        named = f"{PLAIN}, from the teacher's weights"
        yield _student(f"attfuse-taught-{seed}", "attfuse", named, 2000, 1.5e-3, seed, "teacher")
        for number, (title, (taught, changes)) in enumerate(CHANGES.items()):
            name, named = f"dsrc-{number}-{seed}", f"{DSRC}, {title}"
            yield _student(name, "dsrc", named, 2000, 1.5e-3, seed, "alone", taught, (*VALIDATED, *changes))


def scale(score: Score) -> Iterator[Training]:
    """Yield teacher, plain, DSRC and two rivals at the paper's size, each in parts that begin with the one before.

    A part is a training of its own, with its own fall of the learning rate (warm restarts, I. Loshchilov and
    F. Hutter, ICLR 2017), so that a detector file in half precision is all that the next one needs.
    """
    taught = f"teacher-{SCALE_PARTS}"
    titles = {"teacher": "", "attfuse": PLAIN, "dsrc": DSRC} | {name: name for name in ("v2x-vit", "where2comm")}
    for line, title in titles.items():
        before = "" if line == "teacher" else taught
        for part in range(1, SCALE_PARTS + 1):
            name, named, rate = f"{line}-{part}", title if part == SCALE_PARTS else "", 1.5e-3 / part
            if line == "teacher":
                yield Training(name, "dsrc", "teacher", before, 1500, rate, settings=VALIDATED, base="opv2v")
            else:
                yield _student(name, line, named, 1500, rate, 0, before, taught, base="opv2v")
            before = name


QUESTIONS: dict[str, Plan] = {"rivals": rivals, "parts": parts, "scale": scale}


def pairs(titles: Sequence[str]) -> list[tuple[str, str]]:
    """Return the methods whose difference is asked for: DSRC and each other, but twins of one length and width."""
    found = []
    for title in titles:
        head, _, change = title.partition(", ")
        if head == DSRC and f"{PLAIN}, {change}" in titles:
            found.append((title, f"{PLAIN}, {change}"))
        elif title != DSRC and not (head == PLAIN and f"{DSRC}, {change}" in titles):
            found.append((DSRC, title))
    return found


def _starts() -> Iterator[Training]:
    """Yield the network of single vehicles that all students start from, and the teacher."""
    yield Training("alone", "no-collaboration", "plain", "unparked-plain-alone", 3000, 1.5e-3, settings=VALIDATED)
    yield _teacher("teacher")


def _teacher(name: str, start: str = "unparked-teacher", settings: tuple[str, ...] = ()) -> Training:
    return Training(name, "dsrc", "teacher", start, 1000, 1.5e-3, settings=(*VALIDATED, *settings))


def _student(
    name: str,
    method: str,
    title: str,
    steps: int,
    rate: float,
    seed: int = 0,
    start: str = "alone",
    taught: str = "teacher",
    settings: tuple[str, ...] = VALIDATED,
    base: str = "small",
) -> Training:
    """Return the training of a student, a plain one where its method does not distil."""
    if method.startswith("dsrc"):
        return Training(name, method, "student", start, steps, rate, taught, seed, settings, base, title)
    return Training(name, method, "plain", start, steps, rate, "", seed, settings, base, title)


def _best(names: Sequence[str], score: Score) -> list[str]:
    """Return names of trainings, the best first; unfinished ones last, in their order."""
    return sorted(names, key=lambda name: math.inf if math.isnan(value := score(name)) else -value)
