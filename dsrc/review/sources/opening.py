"""Opening of sources: what a path holds, told at once where it is wrong."""

import threading
import zipfile
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from dsrc.data.drives import open_drives
from dsrc.data.sample import DetectorSettings, Sample, SampleDetector
from dsrc.evaluation.config import named
from dsrc.evaluation.sharing.stored import FILE as SHARES
from dsrc.evaluation.stored import FILE, has_index
from dsrc.ops.detections import Detections
from dsrc.review.sources.base import DriveSource, Source
from dsrc.review.sources.detected import ComputedSet
from dsrc.review.sources.results import open_results, open_shares
from sim.errors import DataError, SettingsError, complaint


def open_sources(path: Path, data: Path | None = None, engine: str = "auto") -> list[Source]:
    """Open what a path holds.

    | path                                  | sources                                        |
    |---------------------------------------|------------------------------------------------|
    | a drive, or a folder of drives        | the drives                                     |
    | results of an evaluation or benchmark | their drives, with the detections of all methods |
    | shares of `dsrc shares`               | their drives, with who helped                  |
    | run folder of a training              | its validation drives, with its newest weights |
    | an episode log (.npz)                 | the episode                                    |
    | a folder of episode logs              | the episodes, sorted by name                   |

    Args:
        data: where the drives of results or of a training are now; None for where they were.
        engine: execution of the network of a training, see `add_detectors`.

    Raises:
        DataError: the path holds none of these, or something in it is damaged or of other data.
    """
    path = Path(path)
    if has_index(path):
        return [*open_results(path, data)]
    if (path / SHARES).is_file():
        return [*open_shares(path, data)]
    run = next((folder for folder in (path, path / "student") if (folder / "settings.json").is_file()), None)
    if run is not None:
        # Torch and Lightning take seconds to import.
        from dsrc.review.sources.training import open_training

        return [*open_training(run, data, engine)]
    if data is not None:
        expected = f"{FILE} of dsrc evaluate or benchmark, {SHARES} of dsrc shares or settings.json of dsrc model train"
        raise DataError(complaint(path, "drives", expected, "none of them"))
    logs = [path] if path.suffix == ".npz" else _logs(path)
    if logs:
        # The closed loop takes a second to import.
        from dsrc.closed_loop.log import EpisodeLog
        from dsrc.review.sources.episodes import episode_source

        return [episode_source(EpisodeLog.load(log)) for log in logs]
    return [DriveSource(drive) for drive in open_drives(path)]


def _logs(folder: Path) -> list[Path]:
    """Episode logs in a folder or in the `episodes` of a campaign, sorted."""
    for place in (folder, folder / "episodes"):
        found = [path for path in sorted(place.glob("*.npz")) if _is_log(path)]
        if found:
            return found
    return []


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
