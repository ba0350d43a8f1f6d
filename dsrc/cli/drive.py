"""Command `dsrc drive`: closed-loop episodes."""

from typing import Annotated, Literal

import msgspec

from dsrc.cli.options import CHANNELS, CORRUPTIONS, File, Scenario, Severity, choice
from dsrc.cli.progress import progress


class Drive(msgspec.Struct, frozen=True, kw_only=True):
    """Drive closed-loop episodes: the ego brakes for what its perception reports.

    Attributes:
        scenario: shipped scenario, or path of a scenario.toml.
        perception: ground truth, the ego's detector alone, or the detector with collaborators.
        checkpoint: detector file; default: the shipped one.
        corruption: corruption of every agent's sweeps.
        seed: seeds of the episodes, one each.
        duration_s: length of an episode, s.
        channel: radio channel.
        out: CSV file of the results, one row per episode; default: none.
    """

    scenario: Scenario
    perception: Literal["truth", "ego", "dsrc"] = "truth"
    checkpoint: File | None = None
    corruption: Annotated[str, choice(("clean", *CORRUPTIONS))] = "clean"
    level: Severity = Severity()
    seed: tuple[int, ...] = (0,)
    duration_s: float = 20.0
    channel: Annotated[str, choice(CHANNELS)] = "ideal"
    out: File | None = None

    def run(self) -> None:
        """Drive the episodes and print their table."""
        from rich.console import Console

        from dsrc.closed_loop.episodes import drive_episodes

        options = msgspec.structs.asdict(self)
        options |= {"seeds": options.pop("seed"), **msgspec.structs.asdict(options.pop("level"))}
        with progress(f"drive {self.scenario}, perception {self.perception}") as report:
            table = drive_episodes(options.pop("scenario"), **options, progress=report)
        Console(highlight=False).print(table)
