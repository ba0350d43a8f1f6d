"""Plans of the trainings of four questions: rivals, lengths of a training, parts of DSRC, the paper's scale.

A plan is a generator, so that later trainings may depend on how earlier ones ended. It asks by `score`, which waits
until a training is finished: AP@0.5 + AP@0.7 on the validation drives, clean.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

from dsrc.models.fusion import FUSIONS
from dsrc.training.recipes import METHODS, RECIPES, of_method
from studies.shipped.train import Run

Score = Callable[[str], float]
PLAIN, DSRC = "plain twin", "DSRC"
RIVALS = tuple(name for name in METHODS if name != "attfuse" and not name.startswith("dsrc"))
"""Methods that are compared with DSRC and its plain twin."""
REFERENCES = ("no-collaboration", "max-map")
"""Of these those that are nobody's method: never among the strongest."""
RATE = 1.5e-3
RATES = (5e-4, RATE)
"""Peak learning rates that each rival tries; every other training has `RATE`."""
DOUBLED = (1000, 2000, 4000, 8000)
"""Lengths of a method's trainings, steps, each with its own fall of the rate, until a longer one is not better."""
SEEDS, STRONG_SEEDS, STRONGEST, PART_SEEDS = 5, 3, 4, 3
"""Trainings of DSRC and its twin, and of the strongest rivals; their number; trainings of each part."""
VALIDATED = ("keep=best", "validate_every=2", "validation_frames=140")
"""A validation every 500 steps; the best weights count."""
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
MAP_START, RESIDUAL_START = "alone-map", "alone-residual"
"""Networks of single vehicles for methods that fuse one map, and for CoAlign's backbone of residual blocks."""
LENGTHS = {"": 2000, "half as long": 1000, "three times as long": 6000}
TAUGHT = "from the teacher's weights"
SCALE_PARTS = 2


@dataclass(frozen=True)
class Training(Run):
    """Training of a plan.

    Attributes:
        title: method of the tables, of which it is a training; "" for a start, a teacher or a trial.
    """

    title: str = ""


Plan = Callable[[Score], Iterator[Training]]


def rivals(score: Score, longest: int = DOUBLED[-1]) -> Iterator[Training]:
    """Yield DSRC, its plain twin and the rivals, each with its own rate and length, from networks of single vehicles.

    The first length is tried with both rates; it is doubled until the longer training is not better, or is the
    longest. All methods are trained at one length before any at the next. The four rivals that are best after their
    first training have two more, DSRC and its twin four.
    """
    yield from _starts()
    yield _alone(MAP_START, "max-map", "augmentation.alone=1")
    yield _alone(RESIDUAL_START, "no-collaboration", 'backbone="resnet"')
    titles = {"attfuse": PLAIN, "dsrc": DSRC} | {name: name for name in RIVALS}
    trials = {method: [_length(method, DOUBLED[0], rate=rate) for rate in RATES] for method in titles}
    for both in trials.values():
        yield from both
    best = {method: max(both, key=lambda trial: score(trial.name)) for method, both in trials.items()}
    growing = list(titles)
    for steps in (steps for steps in DOUBLED[1:] if steps <= longest):
        longer = {method: _length(method, steps, rate=best[method].rate) for method in growing}
        yield from longer.values()
        growing = [method for method, one in longer.items() if score(one.name) > score(best[method].name)]
        best |= {method: longer[method] for method in growing}
    candidates = [name for name in RIVALS if name not in REFERENCES]
    strongest = sorted(candidates, key=lambda name: -score(best[name].name))[:STRONGEST]
    for seed in range(SEEDS):
        trained = ("attfuse", "dsrc", *(strongest if seed < STRONG_SEEDS else ()))
        for method in trained if seed else titles:
            yield _length(method, best[method].steps, seed, titles[method], best[method].rate)


def lengths(score: Score) -> Iterator[Training]:
    """Yield DSRC and its plain twin, trained for three lengths from the same network."""
    yield from _starts()
    for seed in range(PART_SEEDS):
        for method, title in (("attfuse", PLAIN), ("dsrc", DSRC)):
            for length, steps in LENGTHS.items():
                yield _length(method, steps, seed, ", ".join(filter(None, (title, length))))


def parts(score: Score) -> Iterator[Training]:
    """Yield DSRC with one factor changed each: teacher, painting, reconstruction, weights, width, start."""
    yield from _starts()
    yield _teacher("teacher-sparse", settings=("sdd=false",))
    yield _teacher("teacher-unpainted", settings=("pcp=false",))
    yield Training("alone-wide", "no-collaboration", "plain", "", 6000, RATE, settings=(*VALIDATED, *WIDE))
    yield _teacher("teacher-wide", "alone-wide", WIDE)
    for seed in range(PART_SEEDS):
        for method, title in (("attfuse", PLAIN), ("dsrc", DSRC)):
            yield _length(method, LENGTHS[""], seed, title)
            name, named = f"{method}-wide-{seed}", f"{title}, wide"
            yield _student(name, method, named, 2000, RATE, seed, "alone-wide", "teacher-wide", (*VALIDATED, *WIDE))
        for method, title in (("attfuse", PLAIN), ("dsrc", DSRC)):
            named = f"{title}, {TAUGHT}"
            yield _student(f"{method}-taught-{seed}", method, named, 2000, RATE, seed, "teacher")
        for number, (title, (taught, changes)) in enumerate(CHANGES.items()):
            name, named = f"dsrc-{number}-{seed}", f"{DSRC}, {title}"
            yield _student(name, "dsrc", named, 2000, RATE, seed, "alone", taught, (*VALIDATED, *changes))


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
            name, named, rate = f"{line}-{part}", title if part == SCALE_PARTS else "", RATE / part
            if line == "teacher":
                yield Training(name, "dsrc", "teacher", before, 1500, rate, settings=VALIDATED, base="opv2v")
            else:
                yield _student(name, line, named, 1500, rate, 0, before, taught, base="opv2v")
            before = name


QUESTIONS: dict[str, Plan] = {"rivals": rivals, "lengths": lengths, "parts": parts, "scale": scale}


def pairs(titles: Sequence[str]) -> list[tuple[str, str]]:
    """Return the methods whose difference is asked for: DSRC and each other, and twins of one start, length and width.

    Another length or width is compared with its twin alone.
    """
    sizes = (*filter(None, LENGTHS), "wide")
    apart = {f"{title}, {change}" for title in (PLAIN, DSRC) for change in sizes}
    found = [(DSRC, title) for title in titles if title != DSRC and title not in apart]
    found += [(f"{DSRC}, {change}", f"{PLAIN}, {change}") for change in (TAUGHT, *sizes)]
    return [pair for pair in found if set(pair) <= set(titles)]


def _starts() -> Iterator[Training]:
    """Yield the network of single vehicles and the teacher."""
    yield _alone("alone")
    yield _teacher("teacher")


def _alone(name: str, method: str = "no-collaboration", *settings: str) -> Training:
    """Return the training of a network of single vehicles; all of them begin with the same one, as far as it fits."""
    return Training(name, method, "plain", "unparked-plain-alone", 3000, RATE, settings=(*VALIDATED, *settings))


def _teacher(name: str, start: str = "unparked-teacher", settings: tuple[str, ...] = ()) -> Training:
    return Training(name, "dsrc", "teacher", start, 1000, RATE, settings=(*VALIDATED, *settings))


def _length(method: str, steps: int, seed: int = 0, title: str = "", rate: float = RATE) -> Training:
    """Return the training of a student from its network of single vehicles; questions share it by its name."""
    name = f"{method}-{steps}-{seed}" + ("" if rate == RATE else "-slow")
    return _student(name, method, title, steps, rate, seed, start_of(method))


def start_of(method: str) -> str:
    """Return the name of the network of single vehicles that has a method's layers, all but those of its fusion."""
    model = of_method(RECIPES["small"](), method).model
    if model.backbone_name == "resnet":
        return RESIDUAL_START
    return MAP_START if FUSIONS[model.fusion].place == "map" else "alone"


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
