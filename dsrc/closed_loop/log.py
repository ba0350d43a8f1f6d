"""Episode log: everything of an episode in one small file, for metrics computed offline, replay and review.

Traffic, percepts, tracks and routes are held as whole numbers of a resolution, object by object, as differences of
what came before, like `sim.traffic.log`; the ego's own state and the decisions exactly. A log rounds when it is made:
metrics of a log that was never saved are those of its file.
"""

from collections.abc import Iterable
from pathlib import Path
from typing import Self

import msgspec
import numpy as np

from dsrc.closed_loop.log_columns import below, rounded_tick, tick_columns
from dsrc.closed_loop.log_reader import ColumnReader, read_ticks
from dsrc.closed_loop.types import Outcome, Tick
from sensors.corruptions import Condition
from sim.contact import Contact
from sim.packed import read_arrays, write_arrays
from sim.reading import parsing
from sim.scenario import Scenario
from sim.traffic.base import Actors
from sim.traffic.log import TrafficLog
from sim.traffic.replay import ReplayTraffic

VERSION = 1


class EpisodeSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings that decide an episode.

    Attributes:
        scenario: scenario as driven, an encounter with its proven draw.
        seed: seed of the episode.
        ego_id: object id of the ego.
        perception: its perception, as the user named it.
        detector: SHA-256 of the detector file; "" without one.
        driver: name of the driver, as the user named it.
        corruption: kind, or `clean`.
        severity: 1 to 5; 0 for clean.
        family: family of the corruption's settings.
        who: agents whose sensors are corrupted.
        channel: name of the radio channel.
        engine: execution of the detector's network.
        loop: further numbers of the loop: durations, intervals, latency, s.
        route_m: distance from the start to the goal, m; None where the traffic has no goal.
        versions: versions of the packages that can change a number.
        fault: faults beside corruption and channel, see `dsrc.faults.fault`; "" without any.
        defence: against attacks, names between commas; "" without any.
        driver_sha256: of a driver of one's own; "" of a shipped one.
    """

    scenario: Scenario
    seed: int
    ego_id: int
    perception: str = "truth"
    detector: str = ""
    driver: str = "planning"
    corruption: str = "clean"
    severity: int = 0
    family: str = "physical"
    who: str = "all"
    channel: str = "ideal"
    engine: str = "fused"
    loop: dict[str, float] = {}
    route_m: float | None = None
    versions: dict[str, str] = {}
    fault: str = ""
    defence: str = ""
    driver_sha256: str = ""

    @property
    def condition(self) -> Condition:
        """Condition of the sensors."""
        return Condition.of(self.corruption, self.severity, self.family, self.who)


class EpisodeLog:
    """Log of one episode.

    Attributes:
        settings: what decided the episode.
        ticks: everything of its steps, rounded to the resolution of the log.
        outcome: how it ended.
        message: explanation of a failed perception or driver, or "".
        actors: ground truth as a traffic log: one step before the first tick, then tick by tick.

    Args:
        before: actors one step before the first tick, the `before` of its perception.
        message: explanation of a failed perception or driver.

    Raises:
        ValueError: a number is not finite, or beyond 1e9 in its unit; only velocities of percepts may be NaN.
    """

    def __init__(
        self, settings: EpisodeSettings, before: Actors, ticks: Iterable[Tick], outcome: Outcome, message: str = ""
    ) -> None:
        self.settings, self.outcome, self.message = settings, outcome, message
        self.actors = TrafficLog(settings.scenario.step_s)
        self.actors.append(before)
        self.ticks: tuple[Tick, ...] = tuple(rounded_tick(tick) for tick in ticks)
        for tick in self.ticks:
            self.actors.append(tick.actors)

    def __len__(self) -> int:
        return len(self.ticks)

    @property
    def contact(self) -> Contact | None:
        """First contact of the ego; None without one."""
        return next((tick.contact for tick in self.ticks if tick.contact is not None), None)

    def replay(self) -> ReplayTraffic:
        """Return the traffic of the episode, bit for bit, for other eyes; it starts one step before the first tick."""
        return ReplayTraffic(f"episode of {self.settings.scenario.name}", self.actors)

    def save(self, path: Path | str) -> Path:
        """Write the log as a .npz, atomically; equal logs give equal bytes."""
        path = Path(path)
        claims = sorted({name for tick in self.ticks for name in tick.claims})
        about = msgspec.to_builtins(
            _About(settings=self.settings, outcome=self.outcome, message=self.message, claims=tuple(claims))
        )
        for name in ("fault", "defence", "driver_sha256"):
            if not about["settings"][name]:
                del about["settings"][name]
        columns = {
            "episode": np.array(VERSION),
            "about": np.array(msgspec.json.encode(about, order="sorted").decode()),
            **below("actors/", self.actors.columns()),
            **tick_columns(self.ticks, claims, self.actors.step_s),
        }
        write_arrays(path, columns)
        return path

    @classmethod
    def load(cls, path: Path | str) -> Self:
        """Read a log.

        Raises:
            DataError: the file is missing, damaged or no episode log.
        """
        path = Path(path)
        reader = ColumnReader(path, read_arrays(path, "episode log"))
        with parsing(path, "episode log"):
            return cls._of(reader)

    @classmethod
    def _of(cls, reader: ColumnReader) -> Self:
        version = reader.columns.get("episode", np.array(-1))
        if version.shape != () or version.dtype.kind not in "iu" or int(version) != VERSION:
            found = str(reader.columns.get("episode", "none"))
            raise reader.wrong("episode", f"an episode log of version {VERSION}", found)
        try:
            about = msgspec.json.decode(str(reader.array("about", "U", ())), type=_About)
        except msgspec.MsgspecError as error:
            raise reader.wrong("about", "settings of an episode", str(error)) from None
        actors = reader.traffic("actors/")
        return cls(about.settings, actors[0], read_ticks(reader, actors, about.claims), about.outcome, about.message)


class _About(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    settings: EpisodeSettings
    outcome: Outcome
    message: str
    claims: tuple[str, ...]
