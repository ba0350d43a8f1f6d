"""Causes of the crashes of a campaign: its logs, with the lines of sight of their worlds, kept for later runs."""

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import msgspec

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.plan import Campaign, PerceptionSpec
from dsrc.closed_loop.causes.cause import Cause, InSight, cause_of
from dsrc.closed_loop.causes.eyes import Eyes
from dsrc.closed_loop.log import EpisodeLog
from dsrc.closed_loop.perception.error_model.model import read_model
from dsrc.closed_loop.perception.open import MODELLED, parse_perception, uses_helpers
from dsrc.closed_loop.types import Outcome
from dsrc.runs.executors import Progress
from sim.files import file_sha256, write_file
from sim.kept.files import kept_file
from sim.traffic.base import Actors


def crash_cause(log: EpisodeLog, cooperative: bool | None = None) -> Cause | None:
    """Return the cause of the crash that an episode ended in; None where it did not crash.

    Args:
        cooperative: whether its perception uses the helpers' messages; None to go by its name.

    Raises:
        ScenarioError: the world of the episode cannot be built.
    """
    if log.outcome is not Outcome.CRASHED:
        return None
    return cause_of(log, sight_of(log, cooperative))


def sight_of(log: EpisodeLog, cooperative: bool | None = None) -> InSight:
    """Return the lines of sight of an episode's perception; its world is built where one is first asked for.

    A helper's LiDAR counts from when the first of its messages arrives.

    Args:
        cooperative: as of `crash_cause`.
    """
    uses = uses_helpers(parse_perception(log.settings.perception).kind) if cooperative is None else cooperative
    eyes: list[Eyes] = []
    heard = _first_heard(log)

    def in_sight(now: Actors, object_id: int) -> bool:
        if not eyes:
            eyes.append(Eyes(log, uses))
        helpers = None if heard is None else {one for one, time_s in heard.items() if time_s <= now.time_s}
        return eyes[0].see(now, object_id, helpers)

    return in_sight


def _first_heard(log: EpisodeLog) -> dict[int, float] | None:
    """Return the time at which the first message of each helper arrived, s; None of a perception without messages."""
    arrivals = [(tick.actors.time_s, link) for tick in log.ticks if tick.percept for link in tick.percept.links]
    if not arrivals:
        return None
    # The earliest comes last, and stays.
    return {link.sender: time_s for time_s, link in reversed(arrivals) if link.received}


def crash_causes(
    plan: Campaign, results: Iterable[EpisodeResult], folder: Path, progress: Progress | None = None
) -> dict[str, Cause]:
    """Return the causes of the crashes of a campaign whose logs are there, by the keys of their episodes.

    Args:
        folder: of the logs.
        progress: called with crashes done and crashes in all.

    Raises:
        DataError: a log is damaged.
        ScenarioError: the world of an episode cannot be built.
    """
    uses = {one.name: one for one in plan.perceptions}
    crashed = {one.key: one for one in results if one.outcome == Outcome.CRASHED.value}
    found = {}
    for done, (key, one) in enumerate(crashed.items(), start=1):
        path = folder / f"{key}.npz"
        if path.is_file() and (cause := _kept(path, _cooperative(uses[one.perception]))) is not None:
            found[key] = cause
        if progress is not None:
            progress(done, len(crashed))
    return found


def _kept(path: Path, cooperative: bool) -> Cause | None:
    """Return the cause of the crash of a log, from the cache folder where it is known."""
    log = EpisodeLog.load(path)
    settings = log.settings
    kept = kept_file("causes", ".json", __name__, settings.scenario, settings.seed, file_sha256(path), cooperative)
    with suppress(OSError, msgspec.MsgspecError):
        return msgspec.json.decode(kept.read_bytes(), type=Cause | None)
    cause = crash_cause(log, cooperative)
    with suppress(OSError):  # a cache that cannot be written to costs time alone
        write_file(kept, msgspec.json.encode(cause))
    return cause


def _cooperative(one: PerceptionSpec) -> bool:
    if one.kind == MODELLED:
        return read_model(Path(one.checkpoint)).cooperative
    return uses_helpers(one.kind)
