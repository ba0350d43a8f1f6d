"""The gauge: equal sweeps are 0 apart, a shift is its distance, and the command writes what it measured."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from dsrc.realism.figures import Samples
from dsrc.realism.gauge import compare, counts_of, families_of, measure, sensors_text
from dsrc.realism.report import family_table
from sim.errors import DataError
from tests.commands import dsrc
from tests.dsrc.evaluation.small import write_drives


def street(rng: np.random.Generator, shift: float = 0.0, values: int = 50) -> Samples:
    return {"range": rng.normal(20 + shift, 3, values), "noise": np.abs(rng.normal(0.02, 0.004, values))}


def test_equal_sweeps_are_not_apart() -> None:
    sweeps = [street(np.random.default_rng(k)) for k in range(6)]
    assert [row.distance for row in compare(sweeps, sweeps)] == [0.0, 0.0]


def test_a_shift_is_its_distance_within_the_interval() -> None:
    real, far = ([street(np.random.default_rng(100 * side + k), 5.0 * side) for k in range(12)] for side in (0, 1))
    row = next(row for row in compare(real, far) if row.figure.name == "range")
    assert row.distance == pytest.approx(5.0, abs=0.5)
    assert row.low < row.distance < row.high
    assert row.halves < 1.0
    assert row.relative == pytest.approx(row.distance / 3.0, rel=0.1)


def test_every_sweep_weighs_the_same() -> None:
    rng = np.random.default_rng(0)
    few, many = street(rng, 0.0, 20), street(rng, 10.0, 100)
    row = next(row for row in compare([few, many], [few]) if row.figure.name == "range")
    assert row.distance == pytest.approx(5.0, abs=1.0)


def test_only_figures_of_both_are_compared() -> None:
    rng = np.random.default_rng(1)
    real, simulated = street(rng), street(rng)
    del simulated["noise"]
    assert [row.figure.name for row in compare([real], [simulated])] == ["range"]


def test_a_family_is_the_mean_of_its_figures() -> None:
    real, far = ([street(np.random.default_rng(10 * side + k), 5.0 * side) for k in range(5)] for side in (0, 1))
    rows = compare(real, far)
    assert families_of(rows) == {row.figure.family: pytest.approx(row.relative) for row in rows}


def test_figures_of_one_number_a_sweep_have_no_spread_below_four_sweeps_and_the_family_says_so() -> None:
    rng = np.random.default_rng(2)
    sweeps = [
        {"elevation": rng.normal(0, 5, 50), "returns_0": np.array([0.9 + 0.01 * k]), "scattered": np.array([0.3])}
        for k in range(4)
    ]
    other = {"elevation": rng.normal(0, 5, 50), "returns_0": np.array([0.1]), "scattered": np.array([0.2])}
    few, enough = (compare(sweeps[:count], [other]) for count in (3, 4))
    assert [math.isnan(row.relative) for row in few] == [True, False, True]
    assert [math.isnan(row.relative) for row in enough] == [False, False, True], "values that are alike have none"
    assert counts_of(few) == {"beams": (1, 2), "roadside": (0, 1)} and math.isnan(families_of(few)["roadside"])
    assert counts_of(enough)["beams"] == (2, 2)
    assert "1 of 2" in family_table(few).markdown()


def test_sweeps_of_several_sensors_are_told() -> None:
    wide, narrow, unknown = {"beams": np.array([64.0])}, {"beams": np.array([32.0])}, dict[str, np.ndarray]()
    assert sensors_text([wide, unknown], [wide]) == "" == sensors_text([unknown], [wide])
    assert "real ones have 64 beams, the simulated ones 32 and 64" in sensors_text([wide], [wide, narrow])


def test_one_seed_gives_one_interval() -> None:
    real, far = ([street(np.random.default_rng(10 * side + k), 1.0 * side) for k in range(5)] for side in (0, 1))
    assert compare(real, far, seed=3) == compare(real, far, seed=3)


def test_drives_without_a_vehicle_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dsrc.realism.gauge.sweeps_of", lambda frame: [])
    with pytest.raises(DataError, match="data: agents: expected a vehicle with a sweep, found none"):
        measure([write_drives(tmp_path / "data", drives=1)])


def test_a_drive_beside_itself(tmp_path: Path) -> None:
    out, drives = tmp_path / "out", write_drives(tmp_path / "data")
    done = dsrc("realism", str(drives), "--simulated", str(drives), "--out", str(out), "--workers", "1")
    assert done.returncode == 0, done.stderr
    written = json.loads((out / "realism.json").read_text())
    found = {one["figure"]: one for one in written["figures"]}
    assert {"range", "residual", "length", "intensity_ground"} <= set(found)
    assert all(one["distance"] == 0.0 for one in found.values())
    assert all(value in (0.0, None) for value in written["families"].values())
    assert written["provenance"]["data"]
    assert {path.name for path in out.iterdir()} == {f"realism.{end}" for end in ("json", "csv", "md", "png")}


def test_a_file_of_another_program_stops_it_before_the_work(tmp_path: Path) -> None:
    out, drives = tmp_path / "out", write_drives(tmp_path / "data", drives=1)
    out.mkdir()
    (out / "realism.csv").write_text("mine\n")
    done = dsrc("realism", str(drives), "--simulated", str(drives), "--out", str(out), "--workers", "1")
    assert done.returncode != 0 and "found realism.csv" in done.stderr
    assert (out / "realism.csv").read_text() == "mine\n" and len(list(out.iterdir())) == 1


def test_a_folder_without_drives_is_named(tmp_path: Path) -> None:
    done = dsrc("realism", str(tmp_path), "--simulated", str(tmp_path), "--out", str(tmp_path / "out"))
    assert done.returncode != 0
    assert str(tmp_path) in done.stderr
    assert not (tmp_path / "out").exists()


def test_no_real_drives_is_an_error(tmp_path: Path) -> None:
    done = dsrc("realism", "--simulated", str(tmp_path), "--out", str(tmp_path / "out"))
    assert done.returncode == 2
    assert "REAL: expected at least one folder of drives, found none" in done.stderr
