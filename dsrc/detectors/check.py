"""Contract check of detectors, of one's own in particular, as gymnasium's `check_env` of environments."""

import copy
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample, SampleRequest, first_agents, inside
from dsrc.detectors.answers import checked
from dsrc.detectors.classes import OwnDetector
from dsrc.detectors.open import close_detector, open_detector
from dsrc.ops.detections import Detections
from sim.boxes import Boxes
from sim.errors import SettingsError, UserError, one_line

_GROUND_M = -1.9


def check_detector(detector: Any) -> None:
    """Check a detector against the contract of `dsrc.data.sample.SampleDetector`.

    Checked are its settings, that it returns finite `Detections` of positive sizes with scores in [0, 1], of several
    agents, of an ego alone and of an empty cloud, the same twice, that it leaves the sample as it was, and that it does
    without the ground truth. All run on a made-up street with three cars.

    Args:
        detector: an instance, a class made without arguments, or a text as `dsrc.detectors.open.open_detector` takes
            it.

    Raises:
        SettingsError: one line per failure; or the detector does not open.
    """
    name = detector if isinstance(detector, str) else getattr(detector, "__name__", type(detector).__name__)
    made = None
    try:
        made = _made(detector)
        failures = (
            list(_Check(made).failures()) if hasattr(made, "detect") else ["detect: expected a method, found none"]
        )
    except UserError as error:
        failures = [str(error)]
    except Exception as error:  # code of one's own can fail in any way
        failures = [f"class: does not work: {type(error).__name__}: {one_line(error, 300)}"]
    finally:
        if made is not None and isinstance(detector, str):
            close_detector(made)
    if failures:
        raise SettingsError("\n".join(f"{name}: {line}" for line in failures))


def _made(detector: Any) -> Any:
    if isinstance(detector, str):
        return open_detector(detector)
    return detector() if isinstance(detector, type) else detector


class _Check:
    """Rules of the contract, run on one detector."""

    def __init__(self, detector: Any) -> None:
        self.detector = detector

    def failures(self) -> Iterator[str]:
        """Yield a line for each broken rule; without settings, only why there are none."""
        settings = getattr(self.detector, "settings", None)
        request = OwnDetector(self.detector).settings.request
        if settings is not None and not isinstance(request, SampleRequest):
            yield f"settings.request: expected a SampleRequest, found {type(request).__name__}"
            return
        self.request = request
        self.sample = _street(request)
        rules: dict[str, Callable[[], str]] = {
            "detect": lambda: self._found(self.sample),
            "ego alone": lambda: self._found(first_agents(self.sample, 1)),
            "empty cloud": lambda: self._found(_emptied(self.sample)),
            "sample": self._untouched,
            "again": self._again,
            "truth": self._truth,
        }
        for name, rule in rules.items():
            try:
                line = rule()
            except Exception as error:  # code of one's own can fail in any way
                line = f"{type(error).__name__}: {one_line(error, 300)}"
            if line:
                yield f"{name}: {line}"
                if name in ("detect", "again"):
                    return

    def _detect(self, sample: Sample) -> Detections:
        """Return what is found in a copy, which the detector may spoil."""
        return self.detector.detect(copy.deepcopy(sample))

    def _found(self, sample: Sample) -> str:
        checked(self._detect(sample), "detections")
        return ""

    def _untouched(self) -> str:
        given = copy.deepcopy(self.sample)
        self.detector.detect(given)
        pairs: list[tuple[Any, Any]] = [
            *zip(given.clouds, self.sample.clouds, strict=True),
            (given.ego_from_agent, self.sample.ego_from_agent),
        ]
        changed = any(not np.array_equal(mine, theirs) for mine, theirs in pairs)
        return "expected the clouds and poses as they were, found others after detect" if changed else ""

    def _again(self) -> str:
        same = _same(self._detect(self.sample), self._detect(self.sample))
        return "" if same else "expected the same detections of the same sample, found others"

    def _truth(self) -> str:
        none = replace(self.sample, boxes=Boxes.zeros(), agent_boxes=(Boxes.zeros(),) * len(self.sample.clouds))
        same = _same(self._detect(self.sample), self._detect(none))
        expected = "expected the same detections without `sample.boxes`, found others: it reads the ground truth"
        return "" if same else expected


def _same(one: Detections, other: Detections) -> bool:
    return np.array_equal(one.boxes.array, other.boxes.array) and np.array_equal(one.score, other.score)


def _street(request: SampleRequest) -> Sample:
    """Return a flat street with three cars, seen by as many agents as the detector takes, at most three."""
    rng = np.random.default_rng(0)
    low, high = np.array(request.grid.range_m[:3]), np.array(request.grid.range_m[3:])
    cars = Boxes.from_array([[x, y, _GROUND_M + 0.8, 4.5, 1.9, 1.6, yaw] for x, y, yaw in _PLACES], object_id=[5, 6, 7])
    cars = cars[inside(cars, request.judged_m)]
    agents = min(3, request.max_agents)
    poses = np.tile(np.eye(4), (agents, 1, 1))
    poses[:, 0, 3] = 12.0 * np.arange(agents)
    clouds = tuple(_cloud(rng, cars, pose[:3, 3], low, high) for pose in poses)
    return Sample("check/1/000000", tuple(range(1, agents + 1)), clouds, poses, cars, (cars,) * agents)


_PLACES = ((8.0, -5.0, 0.0), (16.0, 4.0, 3.1), (-12.0, 6.0, 1.5))


def _cloud(
    rng: np.random.Generator,
    cars: Boxes,
    place: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
) -> NDArray[np.float32]:
    """Return (P, 4) points of the ground around a place and of the cars' sides."""
    reach = 3.0 + 40.0 * rng.random(4000) ** 1.5
    angle = rng.uniform(-np.pi, np.pi, len(reach))
    ground = np.stack([reach * np.cos(angle), reach * np.sin(angle), np.full(len(reach), _GROUND_M)], axis=1)
    parts = [ground + np.array([place[0], place[1], 0.0])]
    for corners in cars.corners():
        edge = rng.integers(0, 4, 200)
        along, up = rng.random((200, 1)), rng.random((200, 1))
        side = corners[edge] * (1 - along) + corners[(edge + 1) % 4] * along
        parts.append(side * (1 - up) + (side + np.array([0.0, 0.0, 1.6])) * up)
    points = np.concatenate(parts) + rng.normal(0.0, 0.01, (sum(map(len, parts)), 3))
    points = points[((points > low) & (points < high)).all(axis=1)]
    return np.concatenate([points, rng.random((len(points), 1))], axis=1).astype(np.float32)


def _emptied(sample: Sample) -> Sample:
    return replace(sample, clouds=tuple(cloud[:0] for cloud in sample.clouds))
