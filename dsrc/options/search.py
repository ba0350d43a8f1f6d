"""Options of `dsrc search`: faults and parameters with ranges, and how they are searched."""

from typing import Annotated, Literal

import msgspec
from msgspec import Meta
from tyro.conf import Positional, arg

from dsrc.options.driving import DRIVERS, PERCEPTIONS
from dsrc.options.fields import CHANNELS, File, choice

OptimizerName = Literal["tpe", "random", "grid"]


class SearchOptions(msgspec.Struct, frozen=True):
    """Options of a search for faults that crash the ego.

    Attributes:
        scenario: scenarios, at least one; default: none.
        perception: what the ego perceives, see dsrc drive.
        fast: perception that drives the search in its place, such as an error model (dsrc model fit) or truth; the
            perception then drives what comes closest to a crash, and tells what is one; default: none.
        judge: episodes of a fast search that the perception drives, the worst first.
        checkpoint: detector file; default: the shipped one.
        fault: faults as dsrc drive takes them, with LOW..HIGH in place of numbers, such as 'control_delay:0..1 from
            1..6 s for 0.5..4 s'; each text is tried by itself; default: none, the parameters alone.
        parameter: parameters of the encounter, NAME for the range it is drawn from or NAME=LOW..HIGH; default: none.
        channel: radio channel.
        seed: seeds of the episodes.
        driver: driver, see dsrc drive; default: planning.
        duration_s: longest episode, s; default: 20, for anticipating 30.
        detect_every_s: interval of detections, s; default: 0.1.
        optimizer: how it is searched, each with a budget of its own: tpe is the tree-structured Parzen estimator of the
            package optuna.
        budget: episodes of each optimiser.
        search_seed: seed of the optimisers.
        failures: distinct failures, the smallest first, of which the smallest fault and the neighbourhood are found;
            each costs some 20 to 40 episodes.
    """

    scenario: Positional[Annotated[tuple[str, ...], arg(metavar="SCENARIO [...]")]] = ()
    perception: Annotated[str, choice(PERCEPTIONS)] = "truth"
    fast: Annotated[str | None, choice(PERCEPTIONS)] = None
    judge: int = 10
    checkpoint: File | None = None
    fault: Annotated[tuple[str, ...], arg(metavar="FAULT [...]")] = ()
    parameter: Annotated[tuple[str, ...], arg(metavar="NAME[=LOW..HIGH] [...]")] = ()
    channel: Annotated[str, choice(CHANNELS)] = "ideal"
    seed: Annotated[tuple[int, ...], Meta(min_length=1)] = (0,)
    driver: Annotated[str | None, choice(DRIVERS)] = None
    duration_s: float | None = None
    detect_every_s: float | None = None
    optimizer: Annotated[tuple[OptimizerName, ...], Meta(min_length=1)] = ("tpe",)
    budget: int = 60
    search_seed: int = 0
    failures: int = 5
