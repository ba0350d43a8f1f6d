"""ComputedSet: detections that a detector makes here, frame by frame."""

import threading

import numpy as np

from dsrc.data.sample import Range, SampleDetector, counted, make_sample, participants
from dsrc.evaluation.detection_table import DetectionTable, one_frame, points_left, points_table
from dsrc.review.sources.base import MemorySet, Setup
from sensors.corruptions import Condition, drive_seed
from sensors.frame import Frame


class ComputedSet(MemorySet):
    """Detections of a detector in the frames of a source, by the protocol of `dsrc evaluate`.

    Args:
        detector: the detector; one frame at a time.
    """

    def __init__(self, name: str, detector: SampleDetector) -> None:
        super().__init__(name, recorded=False)
        self.detector = detector
        self._detecting = threading.Lock()

    def team(self, frame: Frame, ego_id: int, setup: Setup) -> tuple[tuple[int, ...], Range]:
        """Return the agents that take part, the ego first, and the range that is judged, m."""
        request = self.detector.settings.request
        team = tuple(frame.agents[row].agent_id for row in participants(frame, ego_id, request))
        return (team if setup.cooperative else team[:1]), request.judged_m

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
                found[counted(found.boxes, request.judged_m, sample.region)],
                sample.boxes,
                points_table(clean, points_left(clean, corrupted), everyone.agent_ids, objects),
                share[np.searchsorted(clean.truth.object_id, objects)],
            )
            self.put(row, table, setup)
            return table


def corrupted_frame(frame: Frame, condition: Condition, seed: int, drive: str, ego_id: int | None = None) -> Frame:
    """Frame under a condition, as `dsrc evaluate` makes it; agents that are named and absent are left out.

    Args:
        drive: name of the drive, which its seed depends on.
        ego_id: agent that detects; None for the first vehicle.

    Raises:
        SettingsError: the corruption, or one of its parameters, is unknown.
        DataError: a sweep lacks what the corruption needs.
    """
    present = [agent.agent_id for agent in frame.agents]
    return condition.among(present).apply(frame, drive_seed(seed, drive), ego_id)
