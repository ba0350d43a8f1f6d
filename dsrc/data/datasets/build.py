"""The factory of datasets: every drive of a TOML of splits, by any number of workers, with a manifest and data cards.

A drive is a work item. What is finished is left alone, what was cut goes on, and the bytes of the whole tree are the
same for any number of workers, any executor and any number of interruptions.
"""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

from dsrc.data.checksums import SUMS, sha256
from dsrc.data.datasets.manifest import MANIFEST, VERSION, Entry, Manifest, read_manifest, write_manifest
from dsrc.data.datasets.spec import Dataset, Item, expand, find_split_file, read_dataset
from dsrc.data.drive_folder import check_same, locked, read_settings
from dsrc.data.executors import Executor, Report, open_executor
from dsrc.data.simulate import TRAFFIC_LOG, WORLD, open_live
from dsrc.data.write import Progress, make_drive, proven
from sim.errors import DataError, SettingsError, complaint, did_you_mean

_PATIENCE_S = 10.0
"""Workers of a driver that was killed end a moment after it."""
_SAVE_EVERY_S = 2.0
_log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class _Work:
    item: Item
    folder: Path
    threads: int | None


def generate_dataset(
    source: Path | str,
    out: Path,
    splits: Sequence[str] = (),
    workers: int | None = None,
    executor: str = "local",
    address: str = "",
    cards: bool = True,
    progress: Progress | None = None,
) -> Path:
    """Make the drives of a TOML of splits that are not there yet; start it again to go on after a stop.

    Args:
        source: the TOML, or the name of a shipped dataset.
        out: folder of the dataset; drives are `out/SPLIT/DRIVE`, beside them `manifest.json` and the data cards.
        splits: make only these; none: all.
        workers: processes; None for one per core.
        executor: one of `dsrc.data.executors.EXECUTORS`.
        address: of a cluster.
        cards: write a data card beside each split.
        progress: called with (frames done, frames wanted).

    Returns:
        `out`.

    Raises:
        SettingsError: the TOML or a setting is wrong.
        ScenarioError: a scenario is unknown or wrong.
        DataError: `out` holds something else, another process is writing it, or drives could not be made; the manifest
            says which.
    """
    dataset, items = _plan(source, splits)
    out = Path(out).resolve()  # workers may have another current folder
    with locked(out, what="dataset"):
        _check_out(out, dataset, items)
        with open_executor(executor, workers, address) as pool:
            failed = _make_all(out, dataset, items, pool, executor == "local" and workers == 1, progress)
            if cards:
                _write_cards(out, items, failed, pool)
    if failed:
        name, reason = next(iter(failed.items()))
        others = f" ({len(failed)} of {len(items)} drives; see {MANIFEST})" if len(failed) > 1 else ""
        raise DataError(f"{out / name}: {reason}{others}")
    return out


def record_dataset(
    source: Path | str,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Path:
    """Simulate all drives of a TOML anew and keep their traffic logs and worlds beside it, for `recorded`.

    Returns:
        The folder of the recordings.
    """
    path = _locate(source)
    dataset = read_dataset(path)
    if not dataset.recorded:
        raise SettingsError(complaint(path, "recorded", "a folder beside the file", "nothing"))
    folder = path.parent / dataset.recorded
    items = expand(Dataset(name=dataset.name, split=dataset.split), path)
    work = [_Work(item, folder / item.split / item.name, None) for item in items]
    done = 0
    with open_executor("local", workers) as pool:
        for outcome in pool.run(_record, work):
            if outcome.error is not None:
                raise outcome.error
            done += 1
            if progress is not None:
                progress(done, len(work))
    return folder


def _plan(source: Path | str, splits: Sequence[str]) -> tuple[Dataset, list[Item]]:
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


def _check_out(out: Path, dataset: Dataset, items: Sequence[Item]) -> None:
    """Refuse a folder that holds another dataset, or drives of other settings, before anything is made."""
    found = read_manifest(out)
    if found is not None and found.name != dataset.name:
        hint = "; choose another folder"
        raise DataError(complaint(out / MANIFEST, "name", f"'{dataset.name}' as asked for now", found.name, hint))
    for item in items:
        settings = read_settings(out / item.path)
        if settings is not None and item.spec.scenario.conflict is None:
            settings.pop("agents", None)
            check_same(out / item.path, settings, item.spec.settings())


def _make_all(
    out: Path, dataset: Dataset, items: Sequence[Item], pool: Executor, alone: bool, progress: Progress | None
) -> dict[str, str]:
    """Make the drives, keep the manifest up to date and return why drives failed."""
    # One core per worker, but all of them for the only one.
    work = [_Work(item, out / item.path, None if alone else 1) for item in items]
    total, frames = sum(item.spec.frames for item in items), [0] * len(items)

    def report(row: int, done: int, wanted: int) -> None:
        # Executors that cannot look into their workers count a drive as one.
        frames[row] = items[row].spec.frames * done // wanted
        if progress is not None:
            progress(sum(frames), total)

    others = _others(out, items)
    entries: dict[str, Entry] = {}
    failed: dict[str, str] = {}
    saved = monotonic()
    for outcome in pool.run(_make, work, report):
        item = items[outcome.row]
        if outcome.error is not None:
            failed[item.path] = str(outcome.error)
        else:
            entries[item.path] = outcome.value
        if monotonic() - saved > _SAVE_EVERY_S:
            _save(out, dataset, items, others, entries, failed)
            saved = monotonic()
    _save(out, dataset, items, others, entries, failed)
    return {item.path: failed[item.path] for item in items if item.path in failed}


def _others(out: Path, items: Sequence[Item]) -> list[Entry]:
    """Return the entries of drives that are not asked for now, such as those of other splits."""
    found, asked = read_manifest(out), {item.path for item in items}
    return [] if found is None else [entry for entry in found.items if entry.drive not in asked]


def _save(
    out: Path,
    dataset: Dataset,
    items: Sequence[Item],
    others: Sequence[Entry],
    entries: dict[str, Entry],
    failed: dict[str, str],
) -> None:
    order = list(dataset.split)
    kept = [entries[item.path] for item in items if item.path in entries]
    listed = sorted([*others, *kept], key=lambda entry: (_place(order, entry.drive.split("/")[0]), entry.drive))
    write_manifest(
        out,
        Manifest(
            version=VERSION,
            name=dataset.name,
            description=dataset.description,
            drives=len(items) + len(others),
            items=tuple(listed),
            failed=dict(sorted(failed.items())),
        ),
    )


def _place(order: Sequence[str], split: str) -> int:
    return order.index(split) if split in order else len(order)


def _make(work: _Work, report: Report) -> Entry:
    """Make one drive and return its entry; runs in a worker."""
    item = work.item
    more = {} if item.proof is None else {"proof": item.proof}
    make_drive(item.spec, work.folder, report, item.recorded, work.threads, more, _PATIENCE_S)
    return _entry(item, work.folder)


def _record(work: _Work, report: Report) -> None:
    """Record one drive, and see that its agents stay for all of it; runs in a worker."""
    spec, more = work.item.spec, {}
    if spec.scenario.conflict is not None:
        spec, more["proof"] = proven(spec)
    for name in (TRAFFIC_LOG, WORLD):
        (work.folder / name).unlink(missing_ok=True)
    work.folder.mkdir(parents=True, exist_ok=True)
    with open_live(
        spec.scenario, spec.seed, spec.frames, spec.interval_s, work.folder / TRAFFIC_LOG, more=more
    ) as live:
        _log.info("%s: agents %s", work.item.path, live.recording.agent_ids)


def _entry(item: Item, drive: Path) -> Entry:
    settings = read_settings(drive) or {}
    agents = settings.get("agents", {})
    lidars = [(one.get("lidar") or {}).get("name", "") for one in agents.values()]
    return Entry(
        drive=item.path,
        key=item.key,
        scenario=item.spec.scenario.name,
        seed=item.spec.seed,
        frames=item.spec.frames,
        agents=tuple(int(agent) for agent in agents),
        lidars=tuple(lidars),
        bytes=sum(path.stat().st_size for path in _files(drive)),
        sha256=sha256(drive / SUMS),
    )


def _files(drive: Path) -> Iterator[Path]:
    return (path for path in drive.rglob("*") if path.is_file() and not path.name.startswith("."))


def _write_cards(out: Path, items: Sequence[Item], failed: dict[str, str], pool: Executor) -> None:
    from dsrc.data.datasets.card import write_card

    for split in dict.fromkeys(item.split for item in items):
        if not any(item.split == split and item.path not in failed for item in items):
            continue
        write_card(out / split, out / f"{split}.card", pool)
