import json
import shutil
from pathlib import Path

import numpy as np
import pytest

from dsrc.data.datasets import convert as module
from dsrc.data.datasets.convert import convert, names_of
from dsrc.data.datasets.corrupt import corrupt_dataset
from dsrc.data.drives import list_drives, open_drives
from dsrc.data.formats.opv2v.reader import PROTOCOL, DriveReader, with_clouds, write_frame
from dsrc.data.formats.yaml import read_yaml
from dsrc.data.write import write_drive
from dsrc.runs.executors import Pool
from sensors.deskew import deskew_frame
from sensors.frame import Frame
from sim.errors import DataError, SettingsError
from tests.dsrc.data import dair_tree, goldens
from tests.dsrc.data.toy import SETTINGS, ToySource, same_frames, toy_frame


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """Two drives of two frames, one of them to validate on."""
    for name in ("train/one", "validate/two"):
        for index in range(2):
            write_frame(tmp_path / "data" / name, toy_frame(index, seed=len(name)))
    return tmp_path / "data"


def tree(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.mark.parametrize("to", ["opv2v", "compact", "dair", "kitti"])
def test_an_interrupted_conversion_resumes_to_the_same_bytes(
    data: Path, tmp_path: Path, to: module.Format, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = tree(convert(data, tmp_path / "whole", to))
    reads = []
    read = DriveReader.read

    def failing(self: DriveReader, i: int) -> Frame:
        reads.append(i)
        if len(reads) == 3:
            raise KeyboardInterrupt
        return read(self, i)

    monkeypatch.setattr(DriveReader, "read", failing)
    with pytest.raises(KeyboardInterrupt):
        convert(data, tmp_path / "parts", to)
    reads.extend([-1, -1])
    progress = []
    convert(data, tmp_path / "parts", to, progress=lambda done, total: progress.append((done, total)))
    assert len(reads) == 3 + 2 + 2  # the two frames that were there are not read again
    assert progress[0] == (0, 4) and progress[-1] == (4, 4)
    assert tree(tmp_path / "parts") == whole
    convert(data, tmp_path / "parts", to)
    assert len(reads) == 7 and tree(tmp_path / "parts") == whole
    lost = next(
        path for path in sorted((tmp_path / "parts").rglob("*000000.*")) if path.suffix not in (".json", ".bin")
    )
    lost.unlink()
    convert(data, tmp_path / "parts", to)  # a file that was lost since is written again
    assert tree(tmp_path / "parts") == whole
    (tmp_path / "parts/mine.txt").write_text("a note")
    before = len(reads)
    convert(data, tmp_path / "parts", to)  # one that somebody added begins nothing anew
    assert len(reads) == before


def test_any_number_of_workers_writes_the_same_bytes(data: Path, tmp_path: Path) -> None:
    one, two = (
        convert(data, tmp_path / str(workers), "kitti", agent_id="all", pool=Pool(workers)) for workers in (1, 2)
    )
    assert tree(one) == tree(two)


def test_a_folder_that_holds_something_else_is_refused(data: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("years of work")
    with pytest.raises(DataError, match=r"full: folder: expected a new or empty one, found 'thesis.tex' in it"):
        convert(data, tmp_path / "full", "kitti")
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["thesis.tex"]
    convert(data, tmp_path / "out", "kitti")
    before = tree(tmp_path / "out")
    with pytest.raises(DataError, match=r"conversion.json: to: expected 'dair' as asked for now, found kitti"):
        convert(data, tmp_path / "out", "dair")
    with pytest.raises(DataError, match=r"conversion.json: view: expected 'around'"):
        convert(data, tmp_path / "out", "kitti", view="around")
    with pytest.raises(DataError, match=r"conversion.json: drives: expected the drives asked for now"):
        convert(data / "train", tmp_path / "out", "kitti")
    assert tree(tmp_path / "out") == before


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"to": "kity"}, "to: expected a format, found kity; did you mean 'kitti'"),
        ({"to": "opv2v", "agent_id": "3"}, "--to opv2v holds all agents; leave out --agent-id"),
        ({"to": "dair", "agent_id": "all"}, "agent_id: expected ego or the id of a vehicle"),
        ({"to": "kitti", "agent_id": "me"}, "agent_id: expected ego, all or the id of an agent, found me"),
        ({"to": "kitti", "agent_id": "--5"}, "agent_id: expected ego, all or the id of an agent, found --5"),
        ({"to": "dair", "view": "around"}, "--view is of KITTI's labels; add --to kitti"),
    ],
)
def test_an_option_that_a_format_lacks_is_named(data: Path, tmp_path: Path, options: dict, message: str) -> None:
    with pytest.raises(SettingsError) as caught:
        convert(data, tmp_path / "out", **options)
    assert message in str(caught.value) and not (tmp_path / "out").exists()


def test_the_source_is_not_overwritten(data: Path) -> None:
    for out in (data, data / "new", data.parent):
        with pytest.raises(SettingsError, match="out: expected a folder apart from"):
            convert(data, out, "kitti")


def test_opv2v_to_opv2v_loses_nothing(tmp_path: Path) -> None:
    write_drive(tmp_path / "data" / "d", SETTINGS | {"motion": "raw"}, ToySource().open)
    convert(tmp_path / "data", tmp_path / "out", "opv2v")
    assert tree(tmp_path / "out" / "d") == tree(tmp_path / "data" / "d")


def test_compact_drives_become_opv2v_of_the_same_bytes(tmp_path: Path) -> None:
    write_drive(tmp_path / "data" / "toy", SETTINGS, ToySource().open)
    compact = convert(tmp_path / "data", tmp_path / "compact", "compact")
    assert {path.suffix for path in compact.glob("toy/*/*")} == {".yaml", ".compact"}
    assert all(same_frames(DriveReader(compact / "toy").read(i), toy_frame(i)) for i in range(5))
    back = convert(compact, tmp_path / "back", "opv2v")
    assert tree(back / "toy") == tree(tmp_path / "data" / "toy")
    again = convert(compact, tmp_path / "again", "compact")
    assert tree(again / "toy") == tree(compact / "toy")


def test_a_drive_is_written_compact_as_it_is_converted(tmp_path: Path) -> None:
    write_drive(tmp_path / "data" / "toy", SETTINGS, ToySource().open)
    write_drive(tmp_path / "live" / "toy", with_clouds(SETTINGS, "compact"), ToySource().open)
    compact = convert(tmp_path / "data", tmp_path / "compact", "compact")
    assert tree(compact / "toy") == tree(tmp_path / "live" / "toy")
    with pytest.raises(DataError, match="clouds"):  # PCD files beside compact ones would be a second drive
        write_drive(compact / "toy", SETTINGS, ToySource().open)


def test_trees_of_others_become_compact_ones(tmp_path: Path) -> None:
    source = goldens.unpack_opv2v_mini(tmp_path)
    plain, packed = (open_drives(convert(source, tmp_path / to, to)) for to in ("opv2v", "compact"))
    assert list(map(len, packed)) == list(map(len, open_drives(source)))
    for one, two in zip(plain, packed, strict=True):
        assert all(same_frames(one.read(i), two.read(i)) for i in range(len(one)))


def test_an_unknown_form_of_clouds_is_named(tmp_path: Path) -> None:
    write_drive(tmp_path / "toy", {**SETTINGS, "clouds": "laz"}, ToySource().open)
    with pytest.raises(DataError, match=r"data_protocol\.yaml: testbed\.clouds: expected pcd or compact, found laz"):
        DriveReader(tmp_path / "toy")


def test_drives_of_other_tools_become_drives_of_ours(tmp_path: Path) -> None:
    mini = goldens.unpack_opv2v_mini(tmp_path)
    convert(mini, tmp_path / "out", "opv2v")
    for before, after in zip(open_drives(mini), open_drives(tmp_path / "out"), strict=True):
        assert before.frames == after.frames and before.agents == after.agents
        assert all(same_frames(before.read(i), after.read(i)) for i in range(len(before)))
        assert after.protocol["testbed"]["converted"]["sha256"] == before.digest()


def test_dair_becomes_opv2v_with_unknown_velocities_as_unknown(tmp_path: Path) -> None:
    root = dair_tree.make(tmp_path / "download")
    convert(root / "val", tmp_path / "out", "opv2v")
    after = open_drives(tmp_path / "out")
    assert [drive.drive for drive in after] == [tmp_path / "out" / "val" / name for name in ("12", "3")]
    frame = after[0].read(0)
    assert np.allclose(frame.truth.array, dair_tree.boxes("015345"), atol=1e-6)
    assert np.isnan(frame.velocity).all() and (frame.points_on == 60).all()
    notes = read_yaml(tmp_path / "out" / "val" / "12" / "-1" / "015345.yaml")
    assert len(notes["vehicles"]) == 3 and "speed" not in notes["vehicles"][1]


def test_dair_can_be_corrupted(tmp_path: Path) -> None:
    root = dair_tree.make(tmp_path / "download")
    (first, second) = corrupt_dataset(root, tmp_path / "out", "motion_blur")
    assert [drive.name for drive in (first, second)] == ["3", "12"]
    before, after = (drive.read(0) for drive in (open_drives(root)[1], open_drives(tmp_path / "out" / "12")[0]))
    assert np.array_equal(before.truth.array, after.truth.array)
    assert not np.array_equal(before.agents[0].sweep.points, after.agents[0].sweep.points)


def test_dair_to_dair_keeps_boxes_and_places(tmp_path: Path) -> None:
    root = dair_tree.make(tmp_path / "download", tracks=True)
    convert(root, tmp_path / "out", "dair")
    for before, after in zip(open_drives(root), open_drives(tmp_path / "out"), strict=True):
        for i in range(len(before)):
            one, two = before.read(i), after.read(i)
            assert np.allclose(one.truth.array, two.truth.array, atol=2e-6)
            assert np.array_equal(one.truth.object_id, two.truth.object_id)
            for a, b in zip(one.agents, two.agents, strict=True):
                assert np.allclose(a.sweep.world_points, b.sweep.world_points, atol=1e-5)
                assert a.sweep.time_s == pytest.approx(b.sweep.time_s, abs=1e-6)


def test_dair_keeps_the_points_on_objects_that_no_longer_are_in_the_sweeps(tmp_path: Path) -> None:
    frame = toy_frame(0)
    thin = frame.with_sweeps([agent.sweep[np.arange(0, len(agent.sweep), 80)] for agent in frame.agents])
    write_frame(tmp_path / "thin" / "one", thin)
    write_frame(tmp_path / "foreign" / "one", frame)
    for path in (tmp_path / "foreign").rglob("*.yaml"):
        path.write_text(path.read_text().partition("\n")[2])
    for source in ("thin", "foreign"):
        convert(tmp_path / source, tmp_path / f"{source}-dair", "dair")
        before, after = (open_drives(tmp_path / name)[0].read(0) for name in (source, f"{source}-dair"))
        rows = [before.agents.index(next(a for a in before.agents if a.agent_id == b.agent_id)) for b in after.agents]
        kept = np.isin(before.truth.object_id, after.truth.object_id)
        assert set(before.truth.object_id[(before.points_on[rows] > 0).any(axis=0)]) - {1000} <= set(
            after.truth.object_id
        )
        counts = before.points_on[rows][:, kept]
        own = before.truth.object_id[kept] == np.array([[a.agent_id] for a in after.agents])
        assert np.array_equal(np.where(own, 0, counts), after.points_on) and (after.points_on > 0).any()
    # A tree of an earlier version: objects are listed without a number, and counted in the sweeps.
    for path in (tmp_path / "foreign-dair").rglob("label/*/*.json"):
        labels = json.loads(path.read_text())
        path.write_text(json.dumps([{k: v for k, v in label.items() if k != "points_on"} for label in labels]))
    earlier = open_drives(tmp_path / "foreign-dair")[0].read(0)
    assert ((earlier.points_on > 0) == (after.points_on > 0)).all()


@pytest.mark.parametrize("place", [".", "one/.."])
def test_a_folder_without_a_name_of_its_own_is_read_by_its_real_one(
    data: Path, tmp_path: Path, place: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = tree(convert(data / "train", tmp_path / "whole", "opv2v"))
    monkeypatch.chdir(data / "train")
    assert tree(convert(Path(place), tmp_path / "out", "opv2v")) == whole


def test_a_protocol_of_another_tool_may_have_values_that_we_do_not_write(data: Path, tmp_path: Path) -> None:
    shutil.rmtree(data / "validate")
    for path in data.rglob("*.yaml"):
        path.write_text(path.read_text().partition("\n")[2])
    (data / "train" / "one" / PROTOCOL).write_text("day: 2021-08-22\nworld: {far: .inf, 2021-01-01: [1.5, yes]}\n")
    convert(data, tmp_path / "out", "opv2v")
    (drive,) = open_drives(tmp_path / "out")
    assert drive.protocol["day"] == "2021-08-22"
    assert drive.protocol["world"] == {"far": "inf", "2021-01-01": [1.5, True]}


def test_splits_stay_splits(data: Path, tmp_path: Path) -> None:
    convert(data, tmp_path / "dair", "dair")
    root = tmp_path / "dair" / "cooperative-vehicle-infrastructure"
    assert json.loads((root / "train.json").read_text()) == ["000000", "000001"]
    assert json.loads((root / "val.json").read_text()) == ["000002", "000003"]
    assert [drive.frames for drive in open_drives(tmp_path / "dair" / "val")] == [(2, 3)]
    convert(data, tmp_path / "opv2v", "opv2v")
    assert list_drives(tmp_path / "opv2v" / "validate") == [tmp_path / "opv2v" / "validate" / "two"]


def test_names_that_repeat_get_those_of_their_folders(tmp_path: Path) -> None:
    paths = [Path(name) for name in ("a/x/1", "a/y/1", "a/x/2", "a/test_culvercity/3", "a/testing/4")]
    assert names_of(paths) == ["x/1", "y/1", "2", "test_culvercity/3", "4"]
    with pytest.raises(DataError, match="names that differ"):
        names_of([Path("a/x/1"), Path("b/x/1")])


def test_raw_points_are_compensated_for_formats_without_them(tmp_path: Path) -> None:
    raw = deskew_frame(toy_frame(1), "raw")
    write_frame(tmp_path / "data" / "toy", raw)
    convert(tmp_path / "data", tmp_path / "out", "dair")
    sweep = open_drives(tmp_path / "out")[0].read(0).agents[0].sweep
    assert sweep.motion == "middle"
    assert np.allclose(sweep.points, deskew_frame(raw, "middle").agents[0].sweep.points, atol=1e-5)
