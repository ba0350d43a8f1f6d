"""ComputedSet: detections that a detector makes here, frame by frame."""

import threading

import numpy as np

from dsrc.data.sample import SampleDetector, inside, make_sample
from dsrc.evaluation.conditions import Condition
from dsrc.evaluation.detection_table import DetectionTable, one_frame, points_left, points_table
from dsrc.review.labs.parameters import TunedCondition, tuned_settings
from dsrc.review.sources.base import MemorySet, Setup
from sensors.corruptions import CLEAN, Who, corrupt_frame, drive_seed, parse_who
from sensors.frame import Frame


class ComputedSet(MemorySet):
    """Detections of a detector in the frames of a source, by the protocol of `dsrc evaluate`; see `DetectionSet`.

    Attributes:
        name: of the method, as shown.
        recorded: False.
        detector: the detector.

    Args:
        name: of the method, as shown.
        detector: the detector; one frame at a time.
    """

    def __init__(self, name: str, detector: SampleDetector) -> None:
        super().__init__(name, recorded=False)
        self.detector = detector
        self._detecting = threading.Lock()

    def compute(self, row: int, clean: Frame, corrupted: Frame, setup: Setup) -> DetectionTable:
        """Detect in a frame and keep the detections; those that are known are returned.

        Args:
            row: of the frame in its source.
            corrupted: the same under the setup's condition.

        Raises:
            DataError: the frame lacks the ego.
        """
        with self._detecting:
            known = self.get(row, setup)
            if known is not None:
                return known
            request = self.detector.settings.request
            everyone = sample = make_sample(corrupted, setup.ego_id, request, recorded=clean)
            if not setup.cooperative:
                sample = make_sample(corrupted, setup.ego_id, request, cooperative=False, recorded=clean)
            found = self.detector.detect(sample)
            ego_id, objects = sample.agent_ids[0], sample.boxes.object_id
            share = clean.visible_fraction[[agent.agent_id for agent in clean.agents].index(ego_id)]
            table = one_frame(
                row,
                clean.index,
                ego_id,
                found[inside(found.boxes, request.judged_m)],
                sample.boxes,
                points_table(clean, points_left(clean, corrupted), everyone.agent_ids, objects),
                share[np.searchsorted(clean.truth.object_id, objects)],
            )
            self.put(row, table, setup)
            return table


def present_agents(frame: Frame, text: str) -> Who:
    """Who of a condition is in a frame: agents come and go in a running simulation, and other drives have others."""
    who = parse_who(text)
    if isinstance(who, str):
        return who
    ids = [agent.agent_id for agent in frame.agents]
    return tuple(one for one in who if one in ids)


def corrupted_frame(frame: Frame, condition: Condition, seed: int, drive: str, ego_id: int | None = None) -> Frame:
    """Frame under a condition, as `dsrc evaluate` makes it; agents that are named and absent are left out.

    Args:
        drive: name of the drive, which its seed depends on.
        ego_id: agent that detects; None for the first vehicle.

    Raises:
        SettingsError: the corruption, or one of its parameters, is unknown.
        DataError: a sweep lacks what the corruption needs.
    """
    if condition.kind == CLEAN:
        return frame
    who = present_agents(frame, condition.who)
    if not who:
        return frame
    own = drive_seed(seed, drive)
    settings = tuned_settings(condition) if isinstance(condition, TunedCondition) else None
    return corrupt_frame(
        frame, condition.kind, condition.severity, own, condition.family, ego_id=ego_id, who=who, settings=settings
    )
