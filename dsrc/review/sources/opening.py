"""Opening of sources: what a path holds, told at once where it is wrong."""

import csv
import threading
import zipfile
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from dsrc.data.drives import open_drives
from dsrc.data.formats.kitti_labels import list_labels
from dsrc.data.sample import DetectorSettings, Sample, SampleDetector
from dsrc.detectors.texts import named
from dsrc.evaluation.sharing.stored import FILE as SHARES
from dsrc.evaluation.stored import FILE, has_index
from dsrc.ops.detections import Detections
from dsrc.review.sources.base import DriveSource, Source
from dsrc.review.sources.detected import ComputedSet
from dsrc.review.sources.results import MissingDriveError, open_results, open_shares
from sim.errors import DataError, SettingsError, complaint

_RUN_FILES = (FILE, SHARES, "settings.json", "student/settings.json")
"""Files of which one says that a folder is a run."""


def open_sources(path: Path, data: Path | None = None, engine: str = "auto") -> list[Source]:
    """Open what a path holds.

    | path                                  | sources                                        |
    |---------------------------------------|------------------------------------------------|
    | a drive, or a folder of drives        | the drives                                     |
    | results of an evaluation or benchmark | their drives, with the detections of all methods |
    | shares of `dsrc shares`               | their drives, with who helped                  |
    | run folder of a training              | its validation drives, with its newest weights |
    | an episode log (.npz)                 | the episode                                    |
    | a folder of episode logs              | the episodes, crashes first, by name           |
    | detections as of `dsrc score`         | boxes without clouds; also of results whose drives are gone |
    | a folder of runs                      | their sources; a drive of several runs once, with the methods of all |

    Args:
        data: where the drives of results or of a training are now; None for where they were.
        engine: execution of the network of a training, see `add_detectors`.

    Raises:
        DataError: the path holds none of these, or something in it is damaged or of other data.
    """
    path = Path(path)
    if has_index(path):
        return _results(path, data)
    if (path / SHARES).is_file():
        return [*open_shares(path, data)]
    run = next((folder for folder in (path, path / "student") if (folder / "settings.json").is_file()), None)
    if run is not None:
        # Torch and Lightning take seconds to import.
        from dsrc.review.sources.training import open_training

        return [*open_training(run, data, engine)]
    logs = [path] if path.suffix == ".npz" else _logs(path)
    if data is not None and (logs or not _runs(path)):
        expected = f"{FILE} of dsrc evaluate or benchmark, {SHARES} of dsrc shares or settings.json of dsrc model train"
        raise DataError(complaint(path, "drives", expected, "none of them"))
    if logs:
        # The closed loop takes a second to import.
        from dsrc.closed_loop.log import EpisodeLog
        from dsrc.closed_loop.types import Outcome
        from dsrc.review.sources.episodes import episode_source

        episodes = [EpisodeLog.load(log) for log in logs]
        return [episode_source(log) for log in sorted(episodes, key=lambda one: one.outcome != Outcome.CRASHED)]
    if path.suffix == ".json" or any(path.glob("*_pred.npy")) or (path.is_dir() and list_labels(path)):
        return _boxes(path)
    if runs := _runs(path):
        return _joined({run.name: open_sources(run, data, engine) for run in runs})
    return [DriveSource(drive) for drive in open_drives(path)]


def _results(path: Path, data: Path | None) -> list[Source]:
    """Results with their drives, or the boxes alone where a drive is gone and nobody says where to."""
    try:
        return [*open_results(path, data)]
    except MissingDriveError as error:
        if data is not None:
            raise
        return _boxes(path, f"Boxes of all drives without clouds: {error} by --drives.")


def _boxes(path: Path, note: str = "") -> list[Source]:
    from dsrc.review.sources.boxes import open_boxes

    return [*open_boxes(path, note)]


def _runs(folder: Path) -> list[Path]:
    """Folders of results, shares and trainings in a folder, and those with episodes, sorted."""
    found = [sub for sub in sorted(folder.glob("*/")) if any((sub / name).is_file() for name in _RUN_FILES)]
    return found + [sub for sub in sorted(folder.glob("*/")) if sub not in found and _logs(sub)]


def _joined(runs: Mapping[str, list[Source]]) -> list[Source]:
    """Sources of several runs; those of one drive and seed are one, with the sets of all, named by their runs."""
    sources: dict[tuple[object, ...], Source] = {}
    for run, every in runs.items():
        for source in every:
            folder = getattr(getattr(source, "drive", None), "drive", None)
            if folder is None:
                source.name = f"{run}: {source.name}"
                sources[run, source.name, len(sources)] = source
                continue
            first = sources.setdefault((type(source), folder, source.seed), source)
            named_sets = {f"{run}: {name}": one for name, one in source.sets.items()}
            for name, one in named_sets.items():
                one.name = name
            first.sets = named_sets if first is source else first.sets | named_sets
    return [*sources.values()]


def _logs(folder: Path) -> list[Path]:
    """Episode logs in a folder or in the `episodes` of a campaign, sorted.

    Of a campaign those of its results: logs of the same episodes by an earlier version lie there, too.
    """
    for place in (folder, folder / "episodes"):
        found = [path for path in sorted(place.glob("*.npz")) if _is_log(path)]
        if found:
            keys = _keys(folder / "results.csv")
            return [path for path in found if path.stem in keys] or found
    return []


def _keys(results: Path) -> set[str | None]:
    """Names of the episodes of a table of results; none where there is no such table, or one of another kind."""
    try:
        with results.open(encoding="utf-8", newline="") as file:
            return {row.get("key") for row in csv.DictReader(file)}
    except (OSError, ValueError, csv.Error):
        return set()


def _is_log(path: Path) -> bool:
    """Whether an npz says that it is an episode; a drive's traffic and world are npz too, and a damaged one is none."""
    try:
        with zipfile.ZipFile(path) as archive:
            return "episode.npy" in archive.namelist()
    except (zipfile.BadZipFile, NotImplementedError, ValueError, OSError):
        # Its list may be of another version, or of names that are no text.
        return False


class LateDetector:
    """Detector that is opened once it is asked: a page shows world and points before torch is imported.

    Args:
        opened: function that opens it; what it raises is raised by whoever asks.
    """

    def __init__(self, opened: Callable[[], SampleDetector]) -> None:
        self._opened = opened
        self._detector: SampleDetector | None = None
        self._opening = threading.Lock()

    def open(self) -> SampleDetector:
        """Return the detector, opened now where it was not."""
        with self._opening:
            if self._detector is None:
                self._detector = self._opened()
            return self._detector

    @property
    def settings(self) -> DetectorSettings:
        """Settings of the detector."""
        return self.open().settings

    def detect(self, sample: Sample) -> Detections:
        """Return detections in the sample's frame."""
        return self.open().detect(sample)


def open_late(sources: Sequence[Source]) -> None:
    """Open the detectors that wait for it; raises as `add_detectors`."""
    sets = [one for source in sources for one in source.sets.values() if isinstance(one, ComputedSet)]
    for detector in [one.detector for one in sets]:
        if isinstance(detector, LateDetector):
            detector.open()


def add_detectors(
    sources: Sequence[Source],
    checkpoints: Sequence[str],
    engine: str = "auto",
    height: str = "recorded",
    late: bool = False,
) -> None:
    """Add a computed set for each detector to each source.

    Args:
        checkpoints: detectors, DETECTOR or NAME=DETECTOR, see `dsrc.detectors.open`.
        engine: execution of the networks of files, `auto` or a key of `dsrc.models.storage.deploy.ENGINES`.
        height: ground under the clouds that they get, see `dsrc.detectors.levelled`.
        late: open them once they are asked, or by `open_late`.

    Raises:
        UserError: a detector does not open.
        SettingsError: a name repeats.
    """
    if not checkpoints:
        return
    detectors: dict[str, LateDetector] = {}
    for name, text in named(checkpoints):
        if name in detectors or any(name in source.sets for source in sources):
            raise SettingsError(complaint("view", "checkpoint", "names that differ", name, "; give names: name=path"))
        detectors[name] = LateDetector(partial(_opened, text, engine, height))
    if not late:
        for detector in detectors.values():
            detector.open()
    for source in sources:
        source.sets.update({name: ComputedSet(name, detector) for name, detector in detectors.items()})


def _opened(text: str, engine: str, height: str) -> SampleDetector:
    # Torch takes seconds to import; ground truth alone does without.
    from dsrc.detectors.open import open_detector

    return open_detector(text, engine=engine, use={"height": height})
