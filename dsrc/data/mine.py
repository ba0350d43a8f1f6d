"""Encounters mined from a map into a folder of scenarios."""

import filecmp
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec

from dsrc.runs.executors import SERIAL, Pool
from dsrc.runs.jobs import results_of
from dsrc.runs.unit import Progress
from dsrc.tables.files import csv_text
from sensors.presets import scenario_lidars
from sensors.recording.mining import PROVEN, Finding, judge
from sim.catalog.conflicts import Candidate, find_conflicts, scenario_text
from sim.errors import ScenarioError, SettingsError, complaint
from sim.files import replacing, write_file
from sim.roads.networks import names_network, read_network, resolve_network
from sim.scenario import NetworkSpec, Scenario

TABLE = "mined.csv"
"""All candidates that were judged, with their verdicts."""

_BATCH = 8
"""Places judged before the proven encounters are counted: a constant, so that results are those of any workers."""


@dataclass(frozen=True, slots=True)
class _Place:
    """Candidates of one place, and what judges them."""

    candidates: Sequence[Candidate]
    base: Scenario
    seed: int


def mine(
    base: Scenario, out: Path, count: int = 20, seed: int = 0, pool: Pool = SERIAL, progress: Progress | None = None
) -> list[Finding]:
    """Write encounters of a map, each as a folder with a scenario.toml, and return all findings in order.

    Args:
        base: place whose map is searched, all of it.
        out: folder of folders; those that are there stay as they are.
        count: stop when so many are proven, at least; those beyond are not written.
        seed: for which they are proven, and of the order of places.
        progress: called with places judged and places of the map.

    Raises:
        SettingsError: a count below 1 or a negative seed.
        ScenarioError: the scenario has no map of SUMO, or one without any conflict.
    """
    for field, value, least in (("count", count, 1), ("seed", seed, 0)):
        if value < least:
            raise SettingsError(complaint("scenario mine", field, f"at least {least}", value))
    if not names_network(base):
        raise ScenarioError(complaint(base.name, "network", "a map: one of shipped, generate, file, wheel", "none"))
    scenario_lidars(base)
    base = msgspec.structs.replace(base, conflict=None)
    _check_files(base.network, out)
    places = find_conflicts(base, read_network(resolve_network(base, seed)), seed)
    findings: list[Finding] = []
    for first in range(0, len(places), _BATCH):
        batch = [_Place(place, base, seed) for place in places[first : first + _BATCH]]
        judged: dict[int, list[Finding]] = {}
        for result in results_of(_judge, batch, pool, progress, done=first, total=len(places)):
            if result.error is not None:
                raise result.error
            judged[result.row] = result.value
        findings += [one for row in sorted(judged) for one in judged[row]]
        if sum(one.verdict == PROVEN for one in findings) >= count:
            break
    network = _portable(base.network, out)
    for one in [one for one in findings if one.scenario is not None][:count]:
        assert one.scenario is not None
        file = out / one.scenario.name / "scenario.toml"
        if not file.is_file():
            write_file(file, scenario_text(msgspec.structs.replace(one.scenario, network=network)))
    head = ("kind", "hidden_by", "place", "verdict", "hidden_s", "helper", "scenario")
    rows = [
        {**{name: getattr(one, name) for name in head[:-1]}, "scenario": one.scenario.name if one.scenario else None}
        for one in findings
    ]
    write_file(out / TABLE, csv_text(rows, head), edited=True)
    return findings


def _judge(place: _Place, _: Progress) -> list[Finding]:
    return judge(place.candidates, place.base, place.seed)


def _own_files(network: NetworkSpec) -> dict[str, Path]:
    """Return the files of a network that no package has, by their fields."""
    paths = {field: Path(getattr(network, field)) for field in ("file", "polygons")}
    return {field: path for field, path in paths.items() if path.is_absolute() and path.is_file()}


def _check_files(network: NetworkSpec, out: Path) -> None:
    """Raise SettingsError where `out` has the file of another map under the name of one of the network's."""
    for path in _own_files(network).values():
        kept = out / path.name
        if kept.is_file() and not filecmp.cmp(path, kept, shallow=False):
            raise SettingsError(complaint(kept, "file", f"that of {path}", "another", "; choose another --out"))


def _portable(network: NetworkSpec, out: Path) -> NetworkSpec:
    """Return a network as a scenario in a folder of `out` names it, its own files copied there once."""
    named = {}
    for field, path in _own_files(network).items():
        if not (out / path.name).is_file():
            with replacing(out / path.name) as temporary:
                shutil.copyfile(path, temporary)
        named[field] = f"../{path.name}"
    return msgspec.structs.replace(network, area_m=None, **named)
