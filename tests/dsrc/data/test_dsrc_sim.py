"""dsrc-sim, the project's own benchmark: its recordings are those of today's scenarios, and its sets share nothing."""

import re
import subprocess
import sys
from collections import Counter
from fnmatch import fnmatch
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import pytest
from msgspec.structs import replace

from dsrc.data.datasets.spec import DriveItem, expand, find_split_file, read_dataset
from dsrc.data.drive_folder import TRAFFIC_LOG, WORLD
from dsrc.data.write import DriveSpec, make_drive
from dsrc.evaluation.detect import frame_positions
from sim.catalog.load import list_scenarios
from sim.traffic.log import TrafficLog
from tests.paths import ROOT

SAME_SITE = {
    "research_junction": "braunschweig",
    "braunschweig_lta_truck": "braunschweig",
    "braunschweig_red_light_runner": "braunschweig",
    "motorway_a10": "koenigs_wusterhausen",
    "resco_ingolstadt1": "ingolstadt",
    "resco_ingolstadt21": "ingolstadt",
    "rilsa_walk": "rilsa_1",
    "rilsa_crowd": "rilsa_1",
    "ingolstadt_crowd": "ingolstadt",
}
"""Places that are parts of one town or one junction."""
LEAST_BOXES = 3.0
"""Boxes a frame of a test drive, on average."""


@cache
def items(name: str = "dsrc-sim") -> tuple[DriveItem, ...]:
    path = find_split_file(name)
    assert path is not None
    return tuple(expand(read_dataset(path), path))


def of_split(split: str) -> list[DriveItem]:
    return [item for item in items() if item.split == split]


def test_it_is_as_large_as_it_says_and_every_drive_is_recorded() -> None:
    frames = Counter[str]()
    for item in items():
        frames[item.split] += item.spec.frames
        assert item.recorded is not None and (item.recorded / WORLD).is_file()
    assert frames["train"] >= 2000 and frames["validation"] >= 400 and frames["test"] >= 600
    assert set(frames) == {"train", "validation", "test"}
    folder = find_split_file("dsrc-sim").parent  # type: ignore[union-attr]
    assert sum(path.stat().st_size for path in folder.rglob("*.npz")) < 8e6


def test_its_test_drives_are_many_short_and_at_ten_hertz() -> None:
    """At 10 Hz a message of the sweep of delays is as old as it says."""
    drives = of_split("test")
    assert len(drives) >= 20 and sum(item.spec.frames for item in drives) >= 920
    assert {(item.spec.frames, item.spec.interval_s) for item in drives} == {(60, 0.1)}


@pytest.mark.parametrize(("limit", "each"), [(184, {8}), (92, {4}), (56, {2, 3})])
def test_a_limited_evaluation_takes_as_many_frames_of_every_test_drive(limit: int, each: set[int]) -> None:
    drives = [SimpleNamespace(frames=range(item.spec.frames), labelled=lambda i: True) for item in of_split("test")]
    assert {len(frames) for frames in frame_positions(drives, limit)} == each  # type: ignore[arg-type]


def test_its_document_has_a_row_for_every_test_drive_with_boxes_that_only_helpers_see() -> None:
    text = (ROOT / "docs" / "datasets.md").read_text(encoding="utf-8")
    block = text.partition("<!-- begin dsrc-sim/drives -->")[2].partition("<!-- end dsrc-sim/drives -->")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in block.strip().splitlines()[2:-1]]
    drives = sorted(of_split("test"), key=lambda item: item.name)
    assert [row[:3] for row in rows] == [[f"`{item.name}`", f"{item.spec.frames}", company(item)] for item in drives]
    for drive, _, _, boxes, per_frame, unseen, _ in rows:
        assert float(per_frame) >= LEAST_BOXES, drive
        assert 0 < int(unseen.replace(",", "").split()[0]) < int(boxes.replace(",", "")), drive


def company(item: DriveItem) -> str:
    """Say how many agents a drive has, as the table does."""
    rule = item.spec.scenario.agents
    vehicles, roadside = len(rule.named) or rule.vehicles, len(rule.roadside)
    return f"{vehicles} + {roadside} roadside" if roadside else f"{vehicles}"


def test_its_notice_names_every_map_and_none_of_them_forbids_commerce() -> None:
    notice = (ROOT / "scenarios" / "dsrc-sim" / "NOTICE.md").read_text(encoding="utf-8")
    names = re.findall(r"`([a-z0-9_*]+)`", notice)
    for item in items():
        network = item.spec.scenario.network
        # TAPAS Cologne, of which RESCO's Cologne is a part, is CC BY-NC-SA 3.0.
        assert not network.wheel.startswith("sumo_rl/"), item.path
        if network.shipped or network.wheel or network.highway_env:
            assert any(fnmatch(item.spec.scenario.name, name) for name in names), item.path


def test_its_sets_share_no_place_and_no_seed() -> None:
    splits = ("train", "validation", "test")
    places = [{place(item) for item in of_split(split)} for split in splits]
    seeds = [{item.spec.seed for item in of_split(split)} for split in splits]
    for sets in (places, seeds):
        assert sum(len(one) for one in sets) == len(set().union(*sets))


def place(item: DriveItem) -> str:
    return SAME_SITE.get(item.spec.scenario.name, item.spec.scenario.name)


def test_the_drives_of_pedestrians_have_places_of_the_same_split_and_seeds_of_their_own() -> None:
    drives = items("dsrc-sim-vulnerable")
    assert {item.split for item in drives} == {"train", "validation"}
    for item in drives:
        assert place(item) in {place(other) for other in of_split(item.split)}
    assert not {item.spec.seed for item in drives} & {item.spec.seed for item in items()}


def test_the_drives_of_pedestrians_are_as_many_as_their_document_says() -> None:
    text = (ROOT / "docs" / "datasets.md").read_text(encoding="utf-8").partition("## dsrc-sim-vulnerable")[2]
    frames = Counter[str]()
    for item in items("dsrc-sim-vulnerable"):
        frames[item.split] += item.spec.frames
    assert f"{frames['train']:,} / {frames['validation']:,} frames" in text


def test_it_has_two_to_five_agents_and_encounters_in_every_set() -> None:
    for split in ("train", "validation", "test"):
        rules = [item.spec.scenario.agents for item in of_split(split)]
        counts = {max(rule.vehicles, len(rule.named)) + len(rule.roadside) for rule in rules}
        assert min(counts) >= 2 and max(counts) <= 5
        assert any(item.spec.scenario.conflict is not None for item in of_split(split))
    everywhere = {len(i.spec.scenario.agents.roadside) + i.spec.scenario.agents.vehicles for i in items()}
    assert everywhere == {2, 3, 4, 5}


@pytest.mark.parametrize("item", items(), ids=lambda item: item.path)
def test_a_log_is_as_long_as_its_drive_and_says_what_it_is_of(item: DriveItem) -> None:
    assert item.recorded is not None
    log = TrafficLog.load(item.recorded / TRAFFIC_LOG)
    assert len(log) >= item.spec.frames and log.about["seed"] == item.spec.seed
    assert item.spec.scenario.name in list_scenarios()
    if item.spec.scenario.conflict is not None:
        assert item.proof is not None and item.proof["proof"]["holds"]


def test_two_frames_of_its_log_are_those_of_a_simulation_of_today(tmp_path: Path) -> None:
    """Where they differ, a scenario has changed: `dsrc dataset record dsrc-sim` records it anew."""
    item = next(item for item in items() if item.name == "four_way_201")
    spec = first_frames(item)
    make_drive(spec, tmp_path / "live", threads=1)
    done = subprocess.run(
        [sys.executable, "-c", WITHOUT_SUMO, item.path, str(tmp_path / "recorded")],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "live" / WORLD).read_bytes() == (tmp_path / "recorded" / WORLD).read_bytes()
    frames = [frames_of(tmp_path / name) for name in ("live", "recorded")]
    assert len(frames[0]) == 2 * 2 * 4 and frames[0] == frames[1]


WITHOUT_SUMO = """
import sys
sys.modules.update(dict.fromkeys(("libsumo", "sumo", "sumolib", "traci", "highway_env")))
from pathlib import Path
from dsrc.data.write import make_drive
from tests.dsrc.data.test_dsrc_sim import first_frames, items
item = next(item for item in items() if item.path == sys.argv[1])
make_drive(first_frames(item), Path(sys.argv[2]), recorded=item.recorded, threads=1)
"""


def first_frames(item: DriveItem) -> DriveSpec:
    return replace(item.spec, frames=2)


def frames_of(drive: Path) -> dict[str, bytes]:
    return {str(path.relative_to(drive)): path.read_bytes() for path in sorted(drive.glob("*/*"))}
