"""Detection in the frames of a drive, clean and corrupted, and the matches with ground truth."""

import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.drives import Drive, labelled_frames
from dsrc.data.sample import DetectorSettings, Sample, SampleDetector, SampleRequest, counted, first_agents, make_sample
from dsrc.detectors.classes import OwnDetector
from dsrc.evaluation.detection_table import DetectionTable, join_tables, one_frame, points_left, points_table
from dsrc.evaluation.listener import Listener, fabricated, lies
from dsrc.evaluation.metrics.ap import Matches, join_matches, match_frames
from dsrc.faults.condition import faults_of, radio_faults
from dsrc.messages.defences import Defence
from dsrc.messages.message import lie_counts, tells_boxes
from dsrc.models.channel import Receiver
from sensors.corruptions import Condition, drive_seed, ego_of
from sensors.frame import Frame
from sim.errors import DataError, UserError, complaint, raised_text
from sim.radio import ChannelSpec, Link

_SENSOR_S = 0.1
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Method:
    """Detector under test, with the number of agents and the channel between them.

    Attributes:
        name: unique.
        detector: the detector.
        agents: most agents whose clouds it gets, the ego's first; None for the number of its settings. The ground truth
            is the same for any number.
        channel: of the messages; without one they arrive at once and are not counted.
        messages: what helpers tell, see `dsrc.evaluation.listener.Listener`.
        defence: of the ego, against helpers that lie.
    """

    name: str
    detector: SampleDetector
    agents: int | None = None
    channel: ChannelSpec | None = None
    messages: str = ""
    defence: Defence = ()

    @property
    def receives(self) -> bool:
        """Whether messages arrive through a channel."""
        return self.channel is not None and self.agents != 1


@dataclass(frozen=True, slots=True, eq=False)
class MethodResult:
    """Result of a method in F frames.

    Attributes:
        table: its detections and the true boxes.
        matches: of these.
        seconds: (F,) time of each detection.
        traffic: (F, 4) bytes, senders, senders received and ages of messages, see `make_row`; None without a channel.
        told: (F, 5) what became of the helpers' boxes, `dsrc.messages.message.LIES`; None where nobody lies in boxes or
            defends.
    """

    table: DetectionTable
    matches: Matches
    seconds: NDArray[np.float64]
    traffic: NDArray[np.float64] | None
    told: NDArray[np.float64] | None = None


def evaluate_drive(
    reader: Drive,
    positions: Sequence[int],
    work: Mapping[Condition, Sequence[Method]],
    seed: int,
    count_frame: Callable[[], None] = lambda: None,
) -> dict[tuple[Condition, str], MethodResult]:
    """Evaluate methods in frames of a drive under conditions.

    Each frame is read once and corrupted once per condition; all methods get the same sweeps. Ground truth is that of
    the clean frame: an object whose points a corruption took away still counts as missed. Detections not wholly inside
    the range in which the detector is judged, or out of the region of the labels, are left out, as such true boxes are.

    Args:
        work: methods of each condition, of different names.
        count_frame: called when a frame is done under a condition.

    Returns:
        Results by condition and method's name, in the order of the work.
    """
    name = reader.drive.name
    own_seed = drive_seed(seed, name)
    read = lru_cache(maxsize=3)(reader.read)
    records = {(condition, method.name): _Record() for condition, methods in work.items() for method in methods}
    receivers: dict[tuple[Condition, str], Receiver] = {}
    listeners: dict[tuple[Condition, str], Listener] = {}
    ego_id = ego_of(read(positions[0]))
    for condition, methods in work.items():
        for method in methods:
            if method.channel is not None and method.receives:
                settings = method.detector.settings
                receivers[condition, method.name] = receiver_of(
                    reader, ego_id, condition, method.channel, settings, seed
                )
            needed = method.messages or method.defence or lies(condition)
            if needed and method.agents != 1 and tells_boxes(method.detector):
                key, means = (condition, method.name), (method.messages, condition, method.defence, own_seed)
                listeners[key] = Listener(method.detector, *means, receivers.get(key))
    for i in positions:
        recorded = FrameHistory(read, i)
        for condition, methods in work.items():
            past = FrameHistory(recorded.at, i, partial(corrupted, condition=condition, seed=own_seed))
            # Who shares no boxes lies in what it measured.
            shared = past
            if lies(condition):
                shared = FrameHistory(past.at, i, partial(fabricated, condition=condition, seed=own_seed))
            made: dict[bool, dict[_SampleKey, Sample]] = {False: {}, True: {}}
            left = points_left(recorded[0], past[0])
            for method in methods:
                key = condition, method.name
                record, listener = records[key], listeners.get(key)
                heard = past if listener else shared
                frames, samples = (heard[0], recorded[0]), made[heard is past]
                sample = _sample(frames, method, samples, name)
                whole = _sample(frames, replace(method, agents=None), samples, name)
                links: tuple[Link, ...] = ()
                start = time.perf_counter()
                if listener is not None:
                    listener.measure(past, recorded, sample)
                saying_s = time.perf_counter() - start
                if key in receivers:
                    grid = method.detector.settings.request.grid
                    sample, links = receivers[key].receive(heard, i, sample, grid)
                    record.traffic.append(_traffic(links))
                start = time.perf_counter()
                with _own_failures(method, f"{reader.drive}: frame {i}"):
                    if listener is None:
                        found = method.detector.detect(sample)
                    else:
                        found, told = listener.detect(sample, links, i)
                        record.told.append(lie_counts(told))
                record.seconds.append(saying_s + time.perf_counter() - start)
                judged = found[counted(found.boxes, method.detector.settings.request.judged_m, whole.region)]
                points = points_table(recorded[0], left, whole.agent_ids, sample.boxes.object_id)
                share = _ego_share(recorded[0], sample)
                ego_id, index = sample.agent_ids[0], recorded[0].index
                record.frames.append(one_frame(i, index, ego_id, judged, sample.boxes, points, share))
            count_frame()
    return {key: record.result() for key, record in records.items()}


@contextmanager
def _own_failures(method: Method, where: str) -> Iterator[None]:
    """Turn whatever a detector of one's own raises into one line."""
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        if not isinstance(method.detector, OwnDetector):
            raise
        raise DataError(
            complaint(where, f"detector '{method.detector.name}'", "detections", raised_text(error))
        ) from None


def receiver_of(
    reader: Drive, ego_id: int, condition: Condition, spec: ChannelSpec, settings: DetectorSettings, seed: int
) -> Receiver:
    """Receiver of the ego of a drive, through a channel under the faults of a condition."""
    step_s = interval_of(reader)
    faulted = radio_faults(faults_of(condition), spec, step_s, ego_id)
    return Receiver(spec, drive_seed(seed, reader.drive.name), step_s, settings, faulted=faulted)


@dataclass(slots=True)
class _Record:
    """Results of a method in the frames so far."""

    frames: list[DetectionTable] = field(default_factory=list)
    seconds: list[float] = field(default_factory=list)
    traffic: list[tuple[float, float, float, float]] = field(default_factory=list)
    told: list[tuple[int, ...]] = field(default_factory=list)

    def result(self) -> MethodResult:
        table = join_tables(self.frames)
        return MethodResult(
            table,
            match_frames(table.results()),
            np.array(self.seconds, np.float64),
            np.array(self.traffic, np.float64) if self.traffic else None,
            np.array(self.told, np.float64) if self.told else None,
        )


def join_results(parts: Sequence[MethodResult]) -> MethodResult:
    """Result of a method in the frames of all parts, at least one."""
    traffic = [part.traffic for part in parts if part.traffic is not None]
    told = [part.told for part in parts if part.told is not None]
    return MethodResult(
        join_tables([part.table for part in parts]),
        join_matches([part.matches for part in parts]),
        np.concatenate([part.seconds for part in parts]),
        np.concatenate(traffic) if traffic else None,
        np.concatenate(told) if told else None,
    )


def _traffic(links: Sequence[Link]) -> tuple[float, float, float, float]:
    heard = [link.age_s for link in links if link.received]
    return float(sum(link.bytes_now for link in links)), float(len(links)), float(len(heard)), float(sum(heard))


def _ego_share(frame: Frame, sample: Sample) -> NDArray[np.float32]:
    """(N,) visibility of the sample's true boxes from the ego."""
    row = [agent.agent_id for agent in frame.agents].index(sample.agent_ids[0])
    return frame.visible_fraction[row][np.searchsorted(frame.truth.object_id, sample.boxes.object_id)]


def corrupted(frame: Frame, condition: Condition, seed: int) -> Frame:
    """Frame as the sensors deliver it under a condition; `seed` is the drive's."""
    return condition.apply(frame, seed)


class FrameHistory(Sequence[Frame]):
    """Frames of a drive from one back to the first, each read when it is first asked for.

    Args:
        read: function from a position in the drive to its frame.
    """

    def __init__(
        self, read: Callable[[int], Frame], position: int, transform: Callable[[Frame], Frame] | None = None
    ) -> None:
        self._read, self._position, self._transform = read, position, transform
        self._frames: dict[int, Frame] = {}

    def __len__(self) -> int:
        return self._position + 1

    def __getitem__(self, which: Any) -> Any:
        if isinstance(which, slice):
            return [self[k] for k in range(*which.indices(len(self)))]
        if not 0 <= which < len(self):
            raise IndexError(which)
        if which not in self._frames:
            frame = self._read(self._position - which)
            self._frames[which] = frame if self._transform is None else self._transform(frame)
        return self._frames[which]

    def at(self, position: int) -> Frame:
        """Return the frame at a position in the drive."""
        return self[self._position - position]


def warn_of_slow_drives(readers: Sequence[Drive]) -> None:
    """Log a warning for drives whose frames are too far apart for the delays of a channel."""
    for reader in readers:
        step_s = interval_of(reader)
        if step_s > _SENSOR_S + 1e-6:
            _log.warning(
                "%s: its frames are %g s apart: any delay up to that gives the frame before",
                *(reader.drive, step_s),
            )


def interval_of(reader: Drive) -> float:
    """Time between the first two frames of a drive, s; 0.1 s for a single frame."""
    step = reader.read(1).time_s - reader.read(0).time_s if len(reader) > 1 else 0.0
    return step if step > 0.0 else _SENSOR_S


def frame_positions(readers: Sequence[Drive], limit: int | None, judged: bool = True) -> list[list[int]]:
    """Positions of the frames with ground truth in each drive: all, or `limit` of them evenly spread over all drives.

    Args:
        judged: False takes frames without ground truth too.

    Raises:
        DataError: no drive has a frame with ground truth, and they are judged.
    """
    taken = labelled_frames if judged else lambda reader: range(len(reader))
    places = [(k, i) for k, reader in enumerate(readers) for i in taken(reader)]
    if not places:
        where = readers[0].drive if readers else "evaluate"
        hint = "; there is nothing to judge: dsrc detect and dsrc view take such drives"
        raise DataError(complaint(where, "ground truth", "boxes of at least one frame", "none", hint))
    if limit is not None and limit < len(places):
        places = [places[i] for i in np.linspace(0, len(places) - 1, limit).round().astype(int)]
    return [[i for drive, i in places if drive == k] for k in range(len(readers))]


_SampleKey = tuple[SampleRequest, int | None]
"""What a sample depends on besides the frame: request and limit on the agents."""


def _sample(frames: tuple[Frame, Frame], method: Method, samples: dict[_SampleKey, Sample], drive: str) -> Sample:
    """Input of a method, of the corrupted and the recorded frame; methods with the same key share it."""
    request = method.detector.settings.request
    key = request, method.agents
    if key not in samples:
        if method.agents is None:
            sample = make_sample(frames[0], None, request, recorded=frames[1])
            samples[key] = replace(sample, key=f"{drive}/{sample.key}")
        else:
            whole = _sample(frames, replace(method, agents=None), samples, drive)
            samples[key] = first_agents(whole, method.agents)
    return samples[key]
