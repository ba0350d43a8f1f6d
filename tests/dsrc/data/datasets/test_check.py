"""dsrc dataset check: a clean tree passes, and every damage is found in the file that has it."""

import struct
from collections.abc import Callable
from pathlib import Path

import pytest

from dsrc.data.checksums import CHECKSUMS, write_checksums
from dsrc.data.datasets.check import check_dataset
from dsrc.data.datasets.manifest import VERSION, Manifest, ManifestEntry, write_manifest
from dsrc.data.formats.opv2v.record import Record
from dsrc.data.write import write_drive
from dsrc.runs.executors import Pool
from sim.files import file_sha256
from tests.dsrc.data.goldens import unpack_opv2v_mini
from tests.dsrc.data.toy import SETTINGS, ToySource


@pytest.fixture
def data(tmp_path: Path) -> Path:
    write_drive(tmp_path / "data" / "train" / "toy_3", SETTINGS, ToySource().open)
    return tmp_path / "data"


def drive_of(data: Path) -> Path:
    return data / "train" / "toy_3"


def faults(data: Path) -> list[str]:
    return [str(fault) for fault in check_dataset(data, Pool(1))]


def entry(data: Path) -> ManifestEntry:
    return ManifestEntry(
        drive="train/toy_3",
        key="0",
        scenario="toy",
        seed=3,
        frames=5,
        agents=(1000, 1002, -1),
        lidars=("toy",) * 3,
        bytes=1,
        sha256=file_sha256(drive_of(data) / CHECKSUMS),
    )


def test_nothing_is_wrong_with_a_drive_as_it_was_written(data: Path) -> None:
    assert faults(data) == []
    write_manifest(data, Manifest(version=VERSION, name="d", description="", drives=1, items=(entry(data),)))
    assert faults(data) == []


def test_faults_of_a_compact_drive_are_those_of_its_files(tmp_path: Path) -> None:
    drive = tmp_path / "toy_3"
    write_drive(drive, {**SETTINGS, "clouds": "compact"}, ToySource().open)
    assert faults(drive) == []
    (drive / "1000/000001.compact").write_bytes((drive / "1000/000001.compact").read_bytes()[:-1])
    (drive / "1002/000002.compact").write_bytes((drive / "1002/000003.compact").read_bytes())
    write_checksums(drive)
    found = faults(drive)
    assert any("1000/000001.compact: blocks: expected" in fault for fault in found)
    assert any("1002/000002.compact: " in fault and "its label says" in fault for fault in found)
    (drive / "-1/000004.compact").unlink()
    assert any("-1/000004.compact" in fault and "missing" in fault for fault in faults(drive))


def test_nothing_is_wrong_with_a_tree_of_another_tool(tmp_path: Path) -> None:
    assert faults(unpack_opv2v_mini(tmp_path)) == []


def test_any_number_of_workers_finds_the_same(data: Path) -> None:
    write_drive(data / "train" / "toy_4", SETTINGS, ToySource().open)
    for drive in ("toy_3", "toy_4"):
        (data / "train" / drive / "1002" / "000001.pcd").unlink()
    alone, together = (check_dataset(data, Pool(workers)) for workers in (1, 2))
    assert alone == together and len({fault.place for fault in alone}) >= 2


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:-7])


def overwrite_first_x(path: Path) -> None:
    content = path.read_bytes()
    start = content.index(b"DATA binary\n") + len(b"DATA binary\n")
    path.write_bytes(content[:start] + struct.pack("<f", float("nan")) + content[start + 4 :])


def replaced(old: str, new: str) -> Callable[[Path], None]:
    def change(path: Path) -> None:
        text = path.read_text()
        assert old in text
        path.write_text(text.replace(old, new, 1))

    return change


DAMAGE: list[tuple[str, Callable[[Path], None], str]] = [
    ("1002/000003.pcd", Path.unlink, "missing"),
    ("-1/000003.yaml", Path.unlink, "missing"),
    ("1000/000002.pcd", cut, "000002.pcd: "),
    ("1000/000002.yaml", cut, "testbed"),
    ("1000/000001.pcd", overwrite_first_x, "a finite number"),
    ("-1/000000.yaml", lambda path: path.write_text("{"), "000000.yaml"),
    ("data_protocol.yaml", replaced("frames: 5", "frames: 6"), "frames"),
]


@pytest.mark.parametrize(("name", "damage", "words"), DAMAGE, ids=[f"{name}-{words}" for name, _, words in DAMAGE])
@pytest.mark.parametrize("sums", [False, True])
def test_damage_is_found_in_its_file(
    data: Path, name: str, damage: Callable[[Path], None], words: str, sums: bool
) -> None:
    """With checksums, and without them, as in trees of other tools."""
    if not sums:
        (drive_of(data) / CHECKSUMS).unlink()
    damage(drive_of(data) / name)
    found = faults(data)
    stem = name.removesuffix(".yaml").removesuffix(".pcd")
    assert any(stem in fault and words in fault for fault in found), found
    assert len(set(found)) == len(found)  # two checks may find the same fault
    if sums:
        assert any(fault.startswith(str(drive_of(data) / name)) for fault in found), found
    untouched = [p for p in drive_of(data).glob("*/*.pcd") if p != drive_of(data) / name]
    named = [path for path in untouched if any(fault.startswith(str(path)) for fault in found)]
    assert not named, found


def change_record(path: Path, **change: object) -> None:
    """Write a record with other values, and a checksum that fits it: as a program with a bug would."""
    import msgspec

    line, _, rest = path.read_text().partition("\n")
    record = msgspec.json.decode(line[len("testbed: '") : -1], type=Record)
    record = msgspec.structs.replace(record, **change)
    text = msgspec.json.encode(record).decode().replace("'", "\\u0027")
    path.write_text(f"testbed: '{text}'\n{rest}")


def turned(x: float) -> list[list[float]]:
    return [[x, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def test_impossible_poses_and_counts_are_found_in_readable_files(data: Path) -> None:
    drive = drive_of(data)
    change_record(drive / "1000" / "000001.yaml", world_from_body=turned(1.2))
    change_record(drive / "1002" / "000002.yaml", points_on=[0, 0, 0, 0, 0, 0])
    far = [[1, 0, 0, 5e3], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    change_record(drive / "-1" / "000003.yaml", world_from_body=far)
    write_checksums(drive)
    source = (drive / "data_protocol.yaml").read_text()
    assert "format: 1" in source
    found = "\n".join(faults(data))
    assert f"{drive / '1000' / '000001.yaml'}: the pose of the body is no rotation" in found
    assert f"{drive / '1002' / '000002.pcd'}: " in found and "its label says 0" in found
    assert f"{drive / '-1' / '000003.yaml'}: the lidar is" in found


def test_the_manifest_is_compared_with_what_is_there(data: Path) -> None:
    listed = entry(data)
    gone = ManifestEntry(
        **{name: getattr(listed, name) for name in listed.__struct_fields__} | {"drive": "test/gone_1"}
    )
    manifest = Manifest(
        version=VERSION, name="d", description="", drives=4, items=(listed, gone), failed={"test/bad_2": "no cars"}
    )
    write_manifest(data, manifest)
    (drive_of(data) / "1000" / "000000.pcd").write_bytes(b"edited")
    write_checksums(drive_of(data))
    found = "\n".join(faults(data))
    assert "gone_1: missing, manifest.json lists it" in found
    assert "bad_2: failed: no cars" in found
    assert "1 of 4 drives are not finished" in found
    assert f"{CHECKSUMS}: differs from the checksum in manifest.json" in found


def test_a_folder_without_drives_is_wrong(tmp_path: Path) -> None:
    assert len(faults(tmp_path)) == 1 and "OPV2V" in faults(tmp_path)[0]
    assert "no such folder" in faults(tmp_path / "none")[0]
