"""FrameStore and Recordings: frames of a source, the latest used kept, and of all sources of a page."""

import contextlib
import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import Drive
from dsrc.faults.condition import Faulted, condition_of
from dsrc.review.sources.base import DriveSource, Setup, Source
from dsrc.review.sources.detected import corrupted_frame
from dsrc.review.sources.history import DriveHistory
from dsrc.review.sources.results import SharedSource
from dsrc.review.state import ReviewState
from dsrc.review.static import StaticPart, static_parts
from sensors.corruptions import CLEAN, CORRUPTIONS, Condition
from sensors.frame import Frame
from sim.errors import DataError, UserError, complaint

T = TypeVar("T")

KEPT = 6
"""Frames that are kept of each kind: 5 agents of 60,000 points take 15 MB."""
_ROUTE_STEP = 20
"""Points of an ego's route between two places around which the world is drawn."""


class LatestUsed(Generic[T]):
    """Cache that drops what was used longest ago; threads may share it, and may then make a value twice."""

    def __init__(self, kept: int) -> None:
        self._kept = kept
        self._values: OrderedDict[Hashable, T] = OrderedDict()
        self._lock = threading.Lock()

    def find(self, key: Hashable) -> T | None:
        """Return the value of a key; None where it is missing."""
        with self._lock:
            if key in self._values:
                self._values.move_to_end(key)
            return self._values.get(key)

    def get(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return the value of a key, made when missing."""
        found = self.find(key)
        if found is not None:
            return found
        made = make()
        with self._lock:
            self._values[key] = made
            self._values.move_to_end(key)
            while len(self._values) > self._kept:
                self._values.popitem(last=False)
        return made


class Pieces(Generic[T]):
    """What is made piece by piece under a key, and anew under another; one thread at a time."""

    def __init__(self) -> None:
        self._key: object = self
        self._made: list[T] = []
        self._more: Iterator[T] = iter(())

    def of(self, key: object, make: Callable[[], Iterator[T]], patience_s: float) -> tuple[list[T], bool]:
        """Return the pieces that are made within some seconds, and whether these are all."""
        if key != self._key:
            self._key, self._made, self._more = key, [], make()
        end = time.monotonic() + patience_s
        while time.monotonic() < end:
            try:
                self._made.append(next(self._more))
            except StopIteration:
                return list(self._made), True
        return list(self._made), False


class FrameStore:
    """Frames of a source.

    Attributes:
        source: the source.

    Args:
        kept: number of frames as recorded, and of corrupted ones.
    """

    def __init__(self, source: Source, kept: int = KEPT) -> None:
        self.source = source
        self._recorded: LatestUsed[Frame] = LatestUsed(kept)
        self._corrupted: LatestUsed[Frame] = LatestUsed(kept)

    def recorded(self, row: int) -> Frame:
        """Return a frame as recorded; raises DataError where it is damaged."""
        return self._recorded.get((self.source.version, row), lambda: self.source.read(row))

    def corrupted(self, row: int, condition: Condition, ego_id: int | None = None) -> Frame:
        """Return a frame under a condition.

        Args:
            ego_id: agent that detects; None for the first vehicle.

        Raises:
            DataError: the frame is damaged, or a sweep lacks what the corruption needs.
            SettingsError: the corruption is unknown.
        """
        frame = self.recorded(row)
        if condition.kind == CLEAN or not any(len(agent.sweep) for agent in frame.agents):
            return frame
        # Few corruptions and choices of agents know an ego, and some faults; the others are the same for all.
        known = CORRUPTIONS.get(condition.kind)
        of_ego = condition.agents in ("ego", "helpers") or (known is not None and known.spares_ego)
        of_ego |= isinstance(condition, Faulted)
        ego = ego_id if of_ego else None
        return self._corrupted.get(
            (self.source.version, row, condition, ego),
            lambda: corrupted_frame(frame, condition, self.source.seed, self.source.name, ego_id),
        )


class Recordings:
    """Sources of a page and their frames, as recorded and corrupted.

    Attributes:
        sources: what is reviewed.
        names: names of the sources.
        stores: frames of each source.
        histories: objects of the frames of each source.
    """

    def __init__(self, sources: Sequence[Source | Drive]) -> None:
        if not sources:
            raise DataError("review: no drives")
        self.sources = [one if isinstance(one, Source) else DriveSource(one) for one in sources]
        self.names = [source.name for source in self.sources]
        self.stores = [FrameStore(source) for source in self.sources]
        self.histories = [DriveHistory(source) for source in self.sources]
        self._origin: dict[int, NDArray[np.float64]] = {}
        self._worlds: dict[int, tuple[list[StaticPart], str]] = {}

    def title(self, drive: int) -> str:
        """Name of a source, after its row where another one has that name too."""
        name = self.names[drive]
        return name if self.names.count(name) == 1 else f"{drive}: {name}"

    def readable_frame(self, drive: int) -> Frame:
        """First frame of a drive that can be read.

        Raises:
            DataError: no frame can be read; what is wrong with the first.
        """
        first: UserError | None = None
        for row in range(self.sources[drive].first, len(self.sources[drive])):
            try:
                return self.stores[drive].recorded(row)
            except UserError as error:
                first = first or error
        raise first or DataError(complaint(self.names[drive], "frames", "at least one frame", "none"))

    def interval_s(self, drive: int) -> float:
        """Time between frames of a drive, s; 0.1 where unknown."""
        first = self.sources[drive].first
        if len(self.sources[drive]) < first + 2:
            return 0.1
        try:
            read = self.stores[drive].recorded
            step = read(first + 1).time_s - read(first).time_s
        except UserError:
            return 0.1
        return step if 0.0 < step < 10.0 else 0.1

    def origin(self, drive: int) -> NDArray[np.float64]:
        """(3,) world position of the review frame's origin, m: the first agent's in the first readable frame.

        Coordinates in the browser then fit float32, and the road is near z = 0.
        """
        if drive not in self._origin:
            self._origin[drive] = self.readable_frame(drive).agents[0].world_from_body[:3, 3].copy()
        return self._origin[drive]

    def has_shares(self, drive: int) -> bool:
        """Whether it is known who helped in a source."""
        return isinstance(self.sources[drive], SharedSource)

    def world(self, drive: int) -> tuple[list[StaticPart], str]:
        """Static world around the agents of a drive, made once, and why it is not drawn, "" where it is."""
        if drive not in self._worlds:
            try:
                self._worlds[drive] = self._static_parts(drive), ""
            except UserError as error:
                self._worlds[drive] = [], str(error)
        return self._worlds[drive]

    def _static_parts(self, drive: int) -> list[StaticPart]:
        source = self.sources[drive]
        first, last = source.first, len(source) - 1
        places: list[NDArray[np.float64]] = []
        for row in sorted({first, (first + last + 1) // 2, last}):
            with contextlib.suppress(UserError):
                places += [agent.world_from_body[:2, 3] for agent in self.stores[drive].recorded(row).agents]
        if (moment := source.moment(first)) is not None:
            # A running episode has not come far.
            places += [*moment.route[::_ROUTE_STEP]]
        return static_parts(dict(source.protocol), self.origin(drive), np.array(places, np.float64), source.folder)

    def ego_id(self, state: ReviewState) -> int:
        """Id of the agent that detects under a state."""
        ids = [agent.agent_id for agent in self.stores[state.drive].recorded(state.frame).agents]
        return state.ego_id if state.ego_id in ids else ids[0]

    def twins(self, drive: int) -> list[int]:
        """Other episodes of the same scenario and seed: with other eyes, faults or another driver."""
        logs = [source.log for source in self.sources]
        draws = [None if log is None else (log.settings.scenario.name, log.settings.seed) for log in logs]
        return [row for row, draw in enumerate(draws) if draw is not None and draw == draws[drive] and row != drive]

    def opening(self, drive: int) -> dict[str, Any]:
        """Fields of the state in which a source opens: an episode before its meeting, with whom the ego meets."""
        met = self.sources[drive].meeting
        return {"frame": self.sources[drive].first} if met is None else {"frame": met.opens, "object_id": met.other_id}

    def setup(self, state: ReviewState) -> Setup:
        """Setup of the detections under a state."""
        condition = condition_of(
            state.corruption, state.severity, state.family, state.corrupted_agents, state.parameters
        )
        return Setup(condition, state.ego_id, state.cooperative)

    def frame(self, state: ReviewState) -> Frame:
        """Frame of a state, corrupted as it says."""
        setup = self.setup(state)
        return self.stores[state.drive].corrupted(state.frame, setup.condition, setup.ego_id)
