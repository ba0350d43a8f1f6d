"""A street of six cars, two of them agents, and a roadside unit, far from the world's origin; and a fake detector."""

import logging
import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.sample import Sample, SampleRequest
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from dsrc.review.model import ReviewModel
from sensors.frame import AgentFrame, Frame
from sensors.sweep import STATIC, Sweep, make_sweep
from sim.boxes import Boxes, concatenate
from sim.geometry import invert, pose_matrix

FAR_AWAY = np.array([4000.0, -2500.0, 80.0])


@pytest.fixture(autouse=True)
def quiet_server_threads() -> None:
    # A server that stops while a browser connects logs that; not what these tests are about.
    logging.getLogger("websockets").setLevel(logging.CRITICAL)


def truth_at(index: int) -> Boxes:
    """Six cars in the world: the ego drives east, the others stand."""
    x = np.array([2.0 * index, 15.0, 30.0, 45.0, 20.0, 60.0])
    y = np.array([0.0, 3.5, 0.0, 3.5, -12.0, 0.0])
    array = np.zeros((6, 7))
    array[:, 0], array[:, 1], array[:, 2] = x, y, 0.8
    array[:, :3] += FAR_AWAY
    array[:, 3:6] = 4.4, 1.9, 1.6
    array[4, 6] = np.pi / 2
    return Boxes.from_array(array, object_id=1000 + np.arange(6))


def sweep_of(truth: Boxes, world_from_lidar: np.ndarray, own: int, time_s: float) -> Sweep:
    """Points on the roofs of the cars and two rings on the road."""
    rng = np.random.default_rng(7)
    points, ids = [], []
    for row, object_id in enumerate(truth.object_id.tolist()):
        if object_id != own:
            local = (rng.random((40, 3)) - 0.5) * truth.size[row] * 0.9
            world = pose_matrix(truth.center[row], truth.yaw[row])
            points.append(local @ world[:3, :3].T + world[:3, 3])
            ids += [object_id] * 40
    angle = np.linspace(0.0, 2.0 * np.pi, 400, endpoint=False)
    for radius in (6.0, 12.0):
        ground = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.zeros(400)], axis=1)
        points.append(ground + np.append(world_from_lidar[:2, 3], FAR_AWAY[2]))
        ids += [STATIC] * 400
    world = np.concatenate(points)
    inverse = invert(world_from_lidar)
    n = len(world)
    return make_sweep(
        world @ inverse[:3, :3].T + inverse[:3, 3],
        world_from_lidar,
        time_s,
        intensity=np.linspace(0, 1, n),
        ring=np.arange(n) // 50,
        object_id=ids,
    )


def street_frame(index: int) -> Frame:
    truth = truth_at(index)
    agents = []
    for row in (0, 2):
        body = pose_matrix(truth.center[row] - [0, 0, 0.8], truth.yaw[row])
        sweep = sweep_of(truth, body @ pose_matrix([0, 0, 1.9]), 1000 + row, 0.1 * index)
        agents.append(AgentFrame(1000 + row, "vehicle", body, 5.0, sweep))
    pole = pose_matrix(FAR_AWAY + np.array([25.0, 10.0, 0.0]), -1.5)
    mast = sweep_of(truth, pole @ pose_matrix([0, 0, 5.0]), -99, 0.1 * index)
    agents.append(AgentFrame(-1, "roadside", pole, 0.0, mast))
    points_on = np.array(
        [[np.count_nonzero(a.sweep.object_id == i) for i in truth.object_id] for a in agents], np.int32
    )
    known = truth.object_id == 1003
    return Frame(
        index=index,
        time_s=0.1 * index,
        agents=tuple(agents),
        truth=truth,
        velocity=known[:, None] * [3.0, 0.0],
        points_on=points_on,
        acceleration=np.where(known[:, None], [-2.5, 9.0], np.nan),
        signals=np.where(known, 8, 0).astype(np.int32),
        lane=tuple(np.where(known, "main_0", "").tolist()),
        visible_fraction=np.where(known, [[0.25], [1.0], [0.5]], np.nan).astype(np.float32),
    )


@dataclass
class FakeDrive:
    drive: Path = Path("street")
    frames: tuple[int, ...] = tuple(range(12))
    reads: list[int] = field(default_factory=list)

    def read(self, i: int) -> Frame:
        self.reads.append(i)
        return street_frame(self.frames[i])


@dataclass
class FakeDetector:
    """Finds all but the last object of a sample, and one ghost with a low score."""

    settings: SampleRequest = field(default_factory=lambda: SampleRequest(GridSpec()))
    samples: list[Sample] = field(default_factory=list)

    def detect(self, sample: Sample) -> Detections:
        self.samples.append(sample)
        found = sample.boxes[: len(sample.boxes) - 1]
        ghost = Boxes.from_array([[10.0, -25.0, -1.0, 4.0, 2.0, 1.5, 0.3]])
        score = np.append(np.linspace(0.9, 0.6, len(found)), 0.4).astype(np.float32)
        return Detections(concatenate([found, ghost]), score)


@pytest.fixture
def frame() -> Frame:
    return street_frame(0)


@pytest.fixture
def drive() -> FakeDrive:
    return FakeDrive()


@pytest.fixture
def detector() -> FakeDetector:
    return FakeDetector()


@pytest.fixture
def model(drive: FakeDrive, detector: FakeDetector) -> ReviewModel:
    return ReviewModel([drive], detector)


@pytest.fixture(scope="module")
def street() -> ReviewModel:
    """Model of three hundred frames, for all tests of a module."""
    return ReviewModel([FakeDrive(frames=tuple(range(300)))], FakeDetector())


@pytest.fixture
def truth_model(drive: FakeDrive) -> ReviewModel:
    return ReviewModel([drive])


@pytest.fixture
def fake_fog(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, str, int]]:
    """Fog that removes every other point and marks the rest; counts its calls."""
    calls = []

    def corrupt_frame(frame: Frame, kind: str, severity: int, seed: int, family: str, **_: object) -> Frame:
        calls.append((frame.index, kind, severity))
        halves = [replace(agent.sweep[::2], lost=len(agent.sweep) // 2) for agent in frame.agents]
        return frame.with_sweeps([replace(s, fate=np.ones(len(s), np.uint8)) for s in halves])

    monkeypatch.setattr("sensors.corruptions.condition.corrupt_frame", corrupt_frame)
    return calls


def cells(html: str) -> list[list[str]]:
    """Texts of the rows of the tables in some HTML, heads too."""
    return [re.findall(r"<t[hd][^>]*>([^<]*)</t", row) for row in re.findall(r"<tr>(.*?)</tr>", html)]
