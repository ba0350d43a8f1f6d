"""The data card counts what is there, and is made anew when that changes."""

import json
from pathlib import Path

import msgspec
import numpy as np
import pytest

from dsrc.data.datasets import card
from dsrc.data.datasets.card import DISTANCE_M, write_card
from dsrc.data.formats.opv2v.reader import DriveReader
from dsrc.data.write import write_drive
from dsrc.runs.executors import Pool
from sim.boxes import CLASSES
from sim.catalog.attribution import BODIES, OPENSTREETMAP
from sim.catalog.load import load_scenario
from sim.errors import DataError
from tests.dsrc.data.goldens import unpack_opv2v_mini
from tests.dsrc.data.toy import SETTINGS, ToySource


@pytest.fixture
def split(tmp_path: Path) -> Path:
    for name in ("toy_3", "toy_4"):
        write_drive(tmp_path / "train" / name, SETTINGS, ToySource().open)
    return tmp_path / "train"


def test_a_card_counts_what_is_in_the_split(split: Path) -> None:
    path = write_card(split)
    assert path == split.parent / "train.card" / "card.md"
    found = json.loads((path.parent / "card.json").read_text())
    assert (found["frames"], found["agent_frames"], found["agents"]) == (10, 30, {"3": 2})
    assert found["connected_vehicles"] == "yes"
    drive, reader = found["drives"][0], DriveReader(split / "toy_3")
    frames = [reader.read(i) for i in range(5)]
    assert drive["points"] == [len(agent.sweep) for frame in frames for agent in frame.agents]
    assert sum(drive["range"]) == sum(
        int((np.linalg.norm(agent.sweep.points, axis=1) <= 200.0).sum()) for frame in frames for agent in frame.agents
    )
    # The ego itself is no box of its own; the bus and the pedestrian are one each per frame.
    assert {name: sum(counts) for name, counts in drive["boxes"].items()} == {
        name: 5 * count for name, count in zip(CLASSES, (2, 0, 1, 1, 0, 0, 1), strict=True)
    }
    assert drive["boxes"]["car"][-1] == 5 and len(drive["boxes"]["car"]) == len(DISTANCE_M)
    assert drive["agents"] == {
        "1000": {"kind": "vehicle", "lidar": "toy"},
        "1002": {"kind": "vehicle", "lidar": "toy"},
        "-1": {"kind": "roadside", "lidar": "toy"},
    }


def test_a_card_has_its_pictures_and_says_where_it_comes_from(split: Path) -> None:
    text = write_card(split).read_text()
    folder = split.parent / "train.card"
    pictures = sorted(path.name for path in folder.glob("*.png"))
    # A picture has the number of its frame: the middle one of five.
    assert pictures == ["drive_0_frame_2.png", "drive_1_frame_2.png", "histograms.png"]
    assert all(f"({name})" in text and (folder / name).stat().st_size > 5000 for name in pictures)
    assert "which OPV2V leaves out" in text and "| toy_3 | OPV2V | 5 |" in text and "numpy" in text


@pytest.mark.slow
def test_the_same_drives_give_the_same_card_and_others_another(split: Path) -> None:
    folder = write_card(split, pool=Pool(2)).parent
    before = {path.name: path.read_bytes() for path in folder.iterdir()}
    (folder / "drive_0_frame_2.png").unlink()
    write_card(split)
    assert not (folder / "drive_0_frame_2.png").exists()  # known to be of these drives, and left alone
    (folder / "card.json").unlink()
    write_card(split)
    assert {path.name: path.read_bytes() for path in folder.iterdir()} == before
    write_drive(split / "toy_5", SETTINGS, ToySource().open)
    write_card(split)
    assert json.loads((folder / "card.json").read_text())["frames"] == 15


def test_a_picture_has_a_legend_of_agents_and_boxes(
    split: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    legends = []
    monkeypatch.setattr(
        "dsrc.tables.figure.write_figure", lambda path, figure, *_, **__: legends.append(figure.legends)
    )
    card._draw_frame(tmp_path / "x.png", DriveReader(split / "toy_3").read(2), "toy")
    names = [text.get_text() for legend in legends[0] for text in legend.get_texts()]
    assert names == ["ego 1000", "vehicle 1002", "roadside -1", "box with points of an agent", "box without"]


def test_a_card_names_the_works_that_its_drives_are_derived_from(tmp_path: Path) -> None:
    for name in ("braunschweig", "four_way"):
        scenario = msgspec.to_builtins(load_scenario(name))
        write_drive(tmp_path / "test" / name, {**SETTINGS, "scenario": scenario}, ToySource().open)
    lines = write_card(tmp_path / "test").read_text().splitlines()
    assert f"* {OPENSTREETMAP} (braunschweig)" in lines
    assert f"* {BODIES}" in lines


def test_trees_of_other_tools_have_cards_too(tmp_path: Path) -> None:
    root = unpack_opv2v_mini(tmp_path)
    text = write_card(root, tmp_path / "card").read_text()
    assert "It is unknown whether" in text and "unknown" in text


def test_a_folder_without_drives_is_named(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="OPV2V"):
        write_card(tmp_path)
