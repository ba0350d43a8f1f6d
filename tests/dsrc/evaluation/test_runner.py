"""An interrupted benchmark resumes, computes only missing cells, and ends with the same bytes."""

import shutil
from collections.abc import Iterator
from dataclasses import replace as changed
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from dsrc.data.drives import list_drives
from dsrc.evaluation import cells, runner
from dsrc.evaluation.cache import CellSettings, read_cell
from dsrc.evaluation.config import Benchmark, DifferenceSpec, MethodSpec, ParameterSweeps
from dsrc.evaluation.detect import Method
from dsrc.evaluation.report.dataset_results import DatasetResults
from dsrc.evaluation.report.report import provenance_of, write_report
from dsrc.evaluation.report.tables import table_1
from dsrc.evaluation.runner import BenchmarkResult, run_plan
from dsrc.models.detector import Detector
from dsrc.models.storage.checkpoint import load_student, save_detector
from dsrc.runs.executors import Pool
from sensors.corruptions import Condition
from sim.errors import CheckpointError, DataError, SettingsError
from sim.radio import PRESETS
from tests.dsrc.evaluation.fakes import detect_all
from tests.dsrc.evaluation.small import make_plan, write_detector, write_drives

TWO = {"DSRC": [("dsrc", 0), ("dsrc", 1)], "alone": [("no-collaboration", 0)]}


@pytest.fixture(scope="module", autouse=True)
def _one_commit() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dsrc.runs.provenance.commit", lambda: "0123456789")
        yield


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("benchmark")
    write_drives(root / "test")
    return root


@pytest.fixture(scope="module")
def plan(root: Path) -> Benchmark:
    sweeps = ParameterSweeps(agents=(1, 2), pose_error=(0.0, 0.5), delay_s=(0.1,), loss=(0.9,))
    return make_plan(root, TWO, corruption=("fog", "beam_missing"), sweeps=sweeps)


@pytest.fixture(scope="module")
def done(plan: Benchmark, root: Path) -> tuple[Path, BenchmarkResult]:
    result = run_plan(plan, root / "done")
    write_report(result, root / "done")
    return root / "done", result


def files(folder: Path) -> dict[str, bytes]:
    """What has to be the same: times and their tables aside."""
    names = ["results.json", "results.csv", *(f"cells/{path.name}" for path in folder.glob("cells/*.npz"))]
    return {name: (folder / name).read_bytes() for name in names}


def unswept(
    done: tuple[Path, BenchmarkResult], plan: Benchmark, folder: Path
) -> tuple[Benchmark, BenchmarkResult, dict[str, bytes]]:
    """Return the plan without its sweeps, and a run of it with its files: its cells are those of the whole plan."""
    part = replace(plan, sweeps=ParameterSweeps())
    shutil.copytree(done[0] / "cells", folder / "cells")
    result = run_plan(part, folder)
    assert result.made == 0
    write_report(result, folder)
    used = {f"cells/{key}.npz" for entry in result.entries for key in entry.cells}
    return part, result, {name: data for name, data in files(folder).items() if name in used or "/" not in name}


def test_a_row_of_a_benchmark_says_what_an_evaluation_says(
    done: tuple[Path, BenchmarkResult], plan: Benchmark, root: Path
) -> None:
    _, result = done
    detector = load_student(root / "dsrc_1.pt")
    direct = detect_all(
        [Method("DSRC", detector, channel=PRESETS["ideal"])], list_drives(root / "test"), plan.corruption
    )
    rows = {e.case.condition.kind: e.row for e in result.entries[:9] if (e.case.method, e.case.training) == ("DSRC", 1)}
    assert set(rows) == {"clean", "fog", "beam_missing"}
    for row in direct[:3]:
        assert rows[row.condition].metrics.items() >= row.metrics.items()
        assert changed(rows[row.condition], metrics=row.metrics) == row
    assert any(row.metrics["ap_bev_30"] > 0 for row in direct)


@pytest.mark.slow
def test_an_interrupted_run_resumes_to_the_same_bytes(
    done: tuple[Path, BenchmarkResult], plan: Benchmark, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, written = root / "killed", []
    part, _, whole = unswept(done, plan, root / "whole")
    write = cells.write_cell

    def dies(folder: Path, settings: Any, result: Any) -> None:
        if len(written) % 5 == 4:
            written.append("died")
            raise KeyboardInterrupt
        written.append(settings.key)
        write(folder, settings, result)

    monkeypatch.setattr(cells, "write_cell", dies)
    deaths = 0
    while True:
        try:
            result = run_plan(part, out)
        except KeyboardInterrupt:
            deaths += 1
            continue
        break
    assert deaths >= 3
    write_report(result, out)
    assert files(out) == whole


def test_a_fault_is_a_column_of_every_table_and_no_part_of_the_summaries(root: Path) -> None:
    mixed = "fog:2 on helpers + loss:0.5"
    plan = make_plan(root, {"A": [("dsrc", 0)]}, corruption=("fog",), family=("physical", "paper"), fault=(mixed,))
    result = run_plan(plan, root / "faults")
    write_report(result, root / "faults")
    for family in plan.family:
        results = DatasetResults.of(result, "made up", family)
        assert (results.kinds(), results.corruptions()) == (["fog", mixed], ["fog"])
        table, (line,) = table_1(results), table_1(results).rows
        (place,) = (row for row, one in enumerate(table.columns) if one.title == mixed.capitalize())
        assert line.cells[place][0].mean == results.rows("A", mixed)[0].metrics["ap_bev_50"]


def test_finished_cells_are_not_computed_again(done: tuple[Path, BenchmarkResult], plan: Benchmark) -> None:
    out, result = done
    before = {path: path.stat().st_mtime_ns for path in out.glob("cells/*")}
    assert result.made == len(before) / 2 > 0
    again = run_plan(plan, out)
    assert again.made == 0
    assert {path: path.stat().st_mtime_ns for path in out.glob("cells/*")} == before
    assert again.entries == result.entries


def test_a_method_that_is_added_costs_its_own_cells_alone(
    done: tuple[Path, BenchmarkResult], plan: Benchmark, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, result = shutil.copytree(done[0], root / "more"), done[1]
    more = make_plan(root, {**TWO, "late": [("late", 0)]}, corruption=plan.corruption, sweeps=plan.sweeps)
    made, write = [], cells.write_cell
    monkeypatch.setattr(cells, "write_cell", lambda f, s, t: (made.append(s.detector), write(f, s, t)))
    after = run_plan(more, out)
    assert set(made) == {after.trained["late"][0].sha256}
    old = [entry for entry in after.entries if entry.case.method != "late"]
    assert old == result.entries
    # A name is no setting: called otherwise, nothing is made anew.
    renamed = replace(
        plan, methods=tuple(replace(m, name=m.name + "!") for m in plan.methods), sweeps=ParameterSweeps()
    )
    assert run_plan(renamed, out).made == 0


@pytest.mark.slow
def test_cells_of_earlier_code_are_taken_when_asked_for(
    done: tuple[Path, BenchmarkResult], plan: Benchmark, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(runner, "code_hash", lambda entry: "0" * 64)
    result = run_plan(plan, root / "reused", reuse=[done[0]])
    assert result.made == 0 and [entry.row for entry in result.entries] == [entry.row for entry in done[1].entries]
    assert not {key for entry in result.entries for key in entry.cells} & {k for e in done[1].entries for k in e.cells}
    assert provenance_of(result)["reused"] == {"results": done[1].made, "listed_in": "cells/reused.json"}
    assert "reused" not in provenance_of(done[1])
    part = replace(plan, corruption=("fog",), sweeps=ParameterSweeps())
    assert run_plan(part, root / "part", reuse=[done[0]]).made == 0
    assert run_plan(replace(part, seed=1), root / "other", reuse=[done[0]]).made > 0


@pytest.mark.slow
def test_two_processes_find_what_one_does(done: tuple[Path, BenchmarkResult], plan: Benchmark, root: Path) -> None:
    part, _, whole = unswept(done, plan, root / "one")
    write_report(run_plan(part, root / "two", Pool(workers=2)), root / "two")
    assert files(root / "two") == whole


@pytest.mark.slow
def test_units_of_few_frames_give_the_same_rows(
    done: tuple[Path, BenchmarkResult], plan: Benchmark, root: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    part, whole, _ = unswept(done, plan, root / "unchunked")
    monkeypatch.setattr(runner, "CHUNK", 1)
    result = run_plan(part, root / "chunks")
    assert [entry.row for entry in result.entries] == [entry.row for entry in whole.entries]
    assert len(result.entries[0].cells) == 4


def test_the_ego_alone_is_the_same_through_every_channel(done: tuple[Path, BenchmarkResult]) -> None:
    _, result = done
    alone = [e for e in result.entries if e.case.method == "alone" and e.case.condition.kind == "clean"]
    assert len(alone) > 3 and len({entry.cells for entry in alone}) == 1
    assert all(entry.row.bytes_per_frame == 0.0 for entry in alone)
    one = next(e.row for e in result.entries if (e.case.method, e.case.agents) == ("DSRC", 1))
    assert one.bytes_per_frame == 0.0
    two = next(e.row for e in result.entries if (e.case.method, e.case.agents) == ("DSRC", 2))
    assert two.bytes_per_frame > 0.0 and two.truth == one.truth


def test_a_sweep_changes_what_arrives(done: tuple[Path, BenchmarkResult]) -> None:
    _, result = done
    rows = {
        (e.case.pose_error, e.case.delay_s, e.case.loss): e.row
        for e in result.entries
        if (e.case.method, e.case.training, e.case.condition.kind, e.case.agents) == ("DSRC", 0, "clean", None)
    }
    assert set(rows) == {(0, 0, 0), (0.5, 0, 0), (0, 0.1, 0), (0, 0, 0.9)}
    assert rows[0, 0, 0].heard == 1.0
    # Of two frames the first has nothing to hear yet, and of nine lost packets in ten no message is whole enough.
    assert rows[0, 0.1, 0].heard == 0.5 and rows[0, 0.1, 0].message_age_s == pytest.approx(0.1)
    assert rows[0, 0, 0.9].heard == 0.0
    assert rows[0.5, 0, 0].metrics != rows[0, 0, 0].metrics


SETTINGS = CellSettings(
    detector="ab",
    use={},
    drive="drive_0",
    data="cd",
    positions=(0, 1),
    condition=Condition("fog", 3).decisive(),
    seed=0,
    channel=PRESETS["ideal"].decisive(),
    agents=5,
    device="cpu",
    engine="fused",
    versions={"torch": "2"},
    code="ef",
)


@pytest.mark.parametrize(
    "change",
    [
        {"detector": "ba"},
        {"use": {"score_threshold": 0.5}},
        {"drive": "drive_1"},
        {"data": "dc"},
        {"positions": (0, 2)},
        {"condition": Condition("fog", 4).decisive()},
        {"condition": Condition("fog", 3, "paper").decisive()},
        {"condition": Condition("snow", 3).decisive()},
        {"condition": Condition("fog", 3, agents="ego").decisive()},
        {"condition": Condition().decisive()},
        {"seed": 1},
        {"channel": None},
        {"channel": PRESETS["c-v2x"].decisive()},
        {"channel": replace(PRESETS["ideal"], packet_loss=0.1).decisive()},
        {"agents": 4},
        {"device": "cuda"},
        {"engine": "bf16"},
        {"versions": {"torch": "3"}},
        {"code": "fe"},
    ],
)
def test_every_setting_has_cells_of_its_own(change: dict[str, Any]) -> None:
    assert replace(SETTINGS, **change).key != SETTINGS.key
    assert {field for field in SETTINGS.__struct_fields__} >= set(change)


def test_a_cell_names_who_is_corrupted_only_where_it_is_not_everyone() -> None:
    assert "who" not in Condition("fog", 3, agents="all").decisive()
    assert Condition("fog", 3, agents="helpers").decisive()["who"] == "helpers"


def test_a_channel_is_what_it_does_and_not_its_name(tmp_path: Path) -> None:
    assert replace(PRESETS["ideal"], name="other").decisive() == PRESETS["ideal"].decisive()
    trace = tmp_path / "trace.csv"
    trace.write_text("time_s,delay_s,loss\n0,0.1,0\n")
    one = replace(PRESETS["trace"], trace=str(trace)).decisive()
    trace.write_text("time_s,delay_s,loss\n0,0.2,0\n")
    assert replace(PRESETS["trace"], trace=str(trace)).decisive() != one


def test_a_damaged_cell_is_named(done: tuple[Path, BenchmarkResult], root: Path) -> None:
    path = next((done[0] / "cells").glob("*.npz"))
    copy = root / path.name
    copy.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(DataError, match=f"{path.name}: cell: expected a whole one.*compute it anew"):
        read_cell(root, path.stem)


def test_damaged_cells_are_computed_again_to_the_same_bytes(
    done: tuple[Path, BenchmarkResult], plan: Benchmark, root: Path
) -> None:
    out = shutil.copytree(done[0], root / "damaged")
    short, wrong, empty, times = sorted((out / "cells").glob("*.npz"))[:4]
    before = {path: path.read_bytes() for path in (short, wrong, empty, times)}
    short.write_bytes(before[short][:-30])
    middle = len(before[wrong]) // 2
    wrong.write_bytes(before[wrong][:middle] + bytes(40) + before[wrong][middle + 40 :])
    empty.write_bytes(b"")
    times.with_suffix(".seconds").write_bytes(b"\xff\x00")
    result = run_plan(plan, out)
    assert result.made == 4 and result.entries == done[1].entries
    assert {path: path.read_bytes() for path in before} == before


def test_a_cell_reads_back(done: tuple[Path, BenchmarkResult]) -> None:
    key = done[1].entries[0].cells[0]
    result = read_cell(done[0] / "cells", key)
    assert result.matches.frames == len(result.seconds) == 2
    assert result.table.ego_share.shape == (result.matches.truth,)
    assert all(m.max(initial=-1) < result.matches.truth for m in result.matches.matched.values())
    assert np.all(np.isfinite(result.matches.score))


def test_mistakes_are_reported_before_the_work(plan: Benchmark, root: Path) -> None:
    missing = replace(plan, methods=(replace(plan.methods[0], detectors=(str(root / "none.pt"),)),))
    with pytest.raises(CheckpointError, match=r"none\.pt"):
        run_plan(missing, root / "wrong")
    mixed = (str(root / "dsrc_0.pt"), str(write_detector(root / "mixed.pt", "dsrc-max")))
    with pytest.raises(SettingsError, match=r"mixed\.pt: settings: expected those of .*dsrc_0\.pt"):
        run_plan(replace(plan, methods=(replace(plan.methods[0], detectors=mixed),)), root / "wrong")
    pair = DifferenceSpec(method="other", baseline=plan.methods[0].name)
    few = Detector(replace(load_student(Path(plan.methods[0].detectors[0])).settings, max_agents=2))
    save_detector(root / "few.pt", few, {"seed": 0}, half=False)
    own = plan.methods[0].detectors
    for detectors, use, told in (
        ((str(root / "few.pt"),), {}, r"few\.pt: max_agents: expected 5, as its baseline 'DSRC' has, .*, found 2"),
        (own, {"team_by": "folders"}, r"dsrc_0\.pt: team_by: expected range, as its baseline .*, found folders"),
        (own, {"judged_by": "opencood"}, r"dsrc_0\.pt: range: expected \(.*, as its baseline .*, found \(-140"),
    ):
        other = MethodSpec(name="other", detectors=detectors, use=use)
        with pytest.raises(SettingsError, match=told):
            run_plan(replace(plan, methods=(*plan.methods, other), differences=(pair,)), root / "wrong")
    assert not (root / "wrong" / "cells").exists()


def test_a_method_may_use_the_same_detectors_otherwise(
    done: tuple[Path, BenchmarkResult], plan: Benchmark, root: Path
) -> None:
    out = shutil.copytree(done[0], root / "otherwise")
    picky = replace(plan.methods[0], name="picky", use={"score_threshold": 0.6})
    both = replace(plan, methods=(plan.methods[0], picky), corruption=("clean",), sweeps=ParameterSweeps())
    result = run_plan(both, out)
    assert result.made == 2 * 2  # two trainings on two drives; the other method's cells are there
    assert result.trained["picky"][0].settings.score_threshold == 0.6
    rows = {(entry.case.method, entry.case.training): entry.row for entry in result.entries}
    assert 0 < rows["picky", 0].detections < rows["DSRC", 0].detections
    with pytest.raises(SettingsError, match=r"dsrc_0\.pt: use: .*score_threshold"):
        run_plan(replace(both, methods=(replace(picky, use={"score_threshold": 2.0}),)), out)
