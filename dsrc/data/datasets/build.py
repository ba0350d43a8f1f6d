"""Build of a dataset: all drives of a split file, with a manifest and data cards.

A drive is a work item. Finished drives are skipped, interrupted ones resume, and the bytes of the tree are the same for
any number of workers, any executor and any number of interruptions.
"""

import logging
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from time import monotonic

import msgspec

from dsrc.data.checksums import CHECKSUMS
from dsrc.data.datasets.manifest import MANIFEST, VERSION, Manifest, ManifestEntry, read_manifest, write_manifest
from dsrc.data.datasets.spec import DatasetSpec, DriveItem, expand, find_split_file, read_dataset
from dsrc.data.drive_folder import TRAFFIC_LOG, WORLD, read_settings
from dsrc.data.formats.opv2v.reader import PROTOCOL
from dsrc.data.simulate import open_simulated
from dsrc.data.write import make_drive, settle_encounter
from dsrc.options.drives import BuildOptions
from dsrc.options.fields import takes_fields
from dsrc.runs.executors import SERIAL, Executor, Pool, Progress
from dsrc.runs.jobs import results_of, run_jobs
from dsrc.runs.lock import locked
from dsrc.runs.series import check_same
from sim.errors import DataError, SettingsError, complaint, did_you_mean
from sim.files import file_sha256

_NEW = ".recording-"
"""How the folder of a recording that is being made begins."""
_PATIENCE_S = 10.0
"""Time to wait for the lock of a drive: workers of a killed process end a moment after it."""
_SAVE_EVERY_S = 2.0
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class BuildJob:
    """Drive of a dataset to make in a folder, with the threads of `sensors.scan.lidar.scan_all`."""

    item: DriveItem
    folder: Path
    threads: int | None = None

    @property
    def group(self) -> tuple[str, int]:
        """Scenario and seed: drives that differ in their sensors alone share their ground."""
        return self.item.spec.scenario.name, self.item.spec.seed


@takes_fields(BuildOptions)
def generate_dataset(options: BuildOptions, pool: Pool = SERIAL, progress: Progress | None = None) -> Path:
    """Generate the missing drives of a dataset; an interrupted run resumes.

    Args:
        options: split file, folder, splits and cards, see `BuildOptions`; or these as arguments.
        progress: called with (frames done, frames in all).

    Returns:
        The folder; beside the splits are `manifest.json` and the data cards.

    Raises:
        SettingsError: the split file or a setting is wrong.
        ScenarioError: a scenario is unknown or wrong.
        DataError: `out` holds another dataset, another process is writing it, or drives failed, which the manifest
            lists.
    """
    dataset, items = _plan(options.dataset, options.splits)
    out = Path(options.out).resolve()  # workers may have another current folder
    with locked(out, what="dataset"):
        _check_out(out, dataset, items)
        with pool.open() as executor:
            failed = _make_all(out, dataset, items, executor, progress)
            if options.cards:
                from dsrc.data.datasets.card import describe

                for split in dict.fromkeys(item.split for item in items if item.path not in failed):
                    describe(out / split, out / f"{split}.card", executor)
    if failed:
        name, reason = next(iter(failed.items()))
        others = f" ({len(failed)} of {len(items)} drives; see {MANIFEST})" if len(failed) > 1 else ""
        raise DataError(f"{out / name}: {reason}{others}")
    return out


def record_dataset(source: Path | str, pool: Pool = SERIAL, progress: Progress | None = None) -> Path:
    """Simulate all drives of a dataset anew and keep their traffic logs and worlds in its folder `recorded`.

    Returns:
        The folder of the recordings.
    """
    path = _locate(source)
    dataset = read_dataset(path)
    if not dataset.recorded:
        raise SettingsError(complaint(path, "recorded", "a folder beside the file", "nothing"))
    folder = path.parent / dataset.recorded
    items = expand(DatasetSpec(name=dataset.name, split=dataset.split), path)
    run_jobs(_record, [BuildJob(item, folder / item.split / item.name) for item in items], pool, progress)
    return folder


def _plan(source: Path | str, splits: Sequence[str]) -> tuple[DatasetSpec, list[DriveItem]]:
    path = _locate(source)
    dataset = read_dataset(path)
    for split in splits:
        if split not in dataset.split:
            hint = did_you_mean(split, dataset.split)
            raise SettingsError(complaint(path, "split", f"a split of {dataset.name}", split, hint))
    return dataset, [item for item in expand(dataset, path) if not splits or item.split in splits]


def _locate(source: Path | str) -> Path:
    path = find_split_file(source)
    if path is None:
        raise SettingsError(complaint(source, "dataset", "a .toml with [[split.NAME]] tables", "none"))
    return path.resolve()


def _check_out(out: Path, dataset: DatasetSpec, items: Sequence[DriveItem]) -> None:
    """Refuse a folder that holds another dataset or drives of other settings, before anything is written."""
    found = read_manifest(out)
    if found is not None and found.name != dataset.name:
        hint = "; choose another folder"
        raise DataError(complaint(out / MANIFEST, "name", f"'{dataset.name}' as asked for now", found.name, hint))
    for item in items:
        if item.recorded is not None and (out / item.path).resolve() == item.recorded.resolve():
            raise SettingsError(complaint("dataset build", "out", "a folder apart from the recordings", str(out)))
        settings = read_settings(out / item.path)
        if settings is not None and item.spec.scenario.conflict is None:
            settings.pop("agents", None)
            check_same(out / item.path / PROTOCOL, settings, item.spec.settings())


def _make_all(
    out: Path, dataset: DatasetSpec, items: Sequence[DriveItem], executor: Executor, progress: Progress | None
) -> dict[str, str]:
    """Generate the drives, keep the manifest up to date and return the reason of each failed drive."""
    jobs = [BuildJob(item, out / item.path, executor.threads) for item in items]
    frames = [item.spec.frames for item in items]
    earlier = _earlier(out, dataset, items)
    entries: dict[str, ManifestEntry] = {}
    failed: dict[str, str] = {}
    saved = monotonic()
    for result in results_of(_make, jobs, executor, progress, frames):
        item = items[result.row]
        if result.error is not None:
            failed[item.path] = str(result.error)
        else:
            entries[item.path] = result.value
        if monotonic() - saved > _SAVE_EVERY_S:
            _save(out, dataset, items, earlier, entries, failed)
            saved = monotonic()
    _save(out, dataset, items, earlier, entries, failed)
    return {item.path: failed[item.path] for item in items if item.path in failed}


def _earlier(out: Path, dataset: DatasetSpec, items: Sequence[DriveItem]) -> Manifest:
    """Return the manifest as it is without the drives of this run: those of other splits stay in it."""
    found, asked = read_manifest(out), {item.path for item in items}
    if found is None:
        return Manifest(version=VERSION, name=dataset.name, description=dataset.description, drives=0, items=())
    items_left = tuple(entry for entry in found.items if entry.drive not in asked)
    failed_left = {drive: reason for drive, reason in found.failed.items() if drive not in asked}
    return msgspec.structs.replace(found, items=items_left, failed=failed_left)


def _save(
    out: Path,
    dataset: DatasetSpec,
    items: Sequence[DriveItem],
    earlier: Manifest,
    entries: dict[str, ManifestEntry],
    failed: dict[str, str],
) -> None:
    kept = [entries[item.path] for item in items if item.path in entries]
    place = {split: row for row, split in enumerate(dataset.split)}

    def by_place(entry: ManifestEntry) -> tuple[int, str]:
        return place.get(entry.drive.partition("/")[0], len(place)), entry.drive

    write_manifest(
        out,
        Manifest(
            version=VERSION,
            name=dataset.name,
            description=dataset.description,
            drives=max(earlier.drives, len(items) + len(earlier.items) + len(earlier.failed)),
            items=tuple(sorted([*earlier.items, *kept], key=by_place)),
            failed=dict(sorted({**earlier.failed, **failed}.items())),
        ),
    )


def _make(job: BuildJob, report: Progress) -> ManifestEntry:
    """Generate one drive and return its entry; a task."""
    item = job.item
    more = {} if item.proof is None else {"proof": item.proof}
    make_drive(item.spec, job.folder, report, item.recorded, job.threads, more, _PATIENCE_S)
    return _entry(item, job.folder)


def _record(job: BuildJob, report: Progress) -> None:
    """Record one drive and check that its agents stay for all of it; a task."""
    spec, more = job.item.spec, {}
    if spec.scenario.conflict is not None:
        spec, more["proof"] = settle_encounter(spec)
    with locked(job.folder, _PATIENCE_S, "recording"):
        for left in job.folder.glob(f"{_NEW}*"):  # by a process that was killed
            shutil.rmtree(left)
        with TemporaryDirectory(prefix=_NEW, dir=job.folder) as name:
            new = Path(name)  # the old recording stays until the new one is whole
            with open_simulated(
                spec.scenario, spec.seed, spec.frames, spec.interval_s, new / TRAFFIC_LOG, more=more
            ) as live:
                _log.info("%s: agents %s", job.item.path, live.recording.agent_ids)
            for file in (new / TRAFFIC_LOG, new / WORLD):
                file.replace(job.folder / file.name)


def _entry(item: DriveItem, drive: Path) -> ManifestEntry:
    settings = read_settings(drive) or {}
    agents = settings.get("agents", {})
    files = (path for path in drive.rglob("*") if path.is_file() and not path.name.startswith("."))
    return ManifestEntry(
        drive=item.path,
        key=item.key,
        scenario=item.spec.scenario.name,
        seed=item.spec.seed,
        frames=item.spec.frames,
        agents=tuple(int(agent) for agent in agents),
        lidars=tuple((one.get("lidar") or {}).get("name", "") for one in agents.values()),
        bytes=sum(path.stat().st_size for path in files),
        sha256=file_sha256(drive / CHECKSUMS),
    )
