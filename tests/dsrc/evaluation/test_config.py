"""Benchmark TOML: it is run as written, and a mistake in it is one line."""

from pathlib import Path
from typing import Any

import pytest

from dsrc.evaluation.config import Benchmark, available, cases_of, plan_of, read_benchmark
from dsrc.options.detection import BenchmarkOptions
from dsrc.options.fields import RENAMED
from dsrc.training.recipes import METHODS
from sensors.corruptions import Condition
from sim.errors import DeprecatedName, SettingsError
from tests.paths import ROOT

SHIPPED = ROOT / "studies/dsrc_paper/benchmark.toml"

GOOD = """
name = "small"
corruption = ["fog", "snow"]
severity = [1, 3]
channel = ["ideal", "its-g5-6"]
frames = 10

[[methods]]
name = "DSRC"
detectors = ["a.pt", "b.pt"]

[[methods]]
name = "Late"
detectors = ["c.pt"]

[[datasets]]
name = "test"
drives = ["data"]

[sweeps]
methods = ["DSRC"]
agents = [1, 2]
pose_error = [0.0, 0.2]
"""


def written(tmp_path: Path, text: str = GOOD) -> Path:
    path = tmp_path / "benchmark.toml"
    path.write_text(text)
    return path


def test_a_file_with_former_names_is_read_and_they_are_told(tmp_path: Path) -> None:
    plan = read_benchmark(written(tmp_path))
    text = GOOD
    for former, name in RENAMED.items():
        text = text.replace(f"\n{name} = ", f"\n{former} = ")
    assert text != GOOD
    with pytest.warns(DeprecatedName) as told:
        assert read_benchmark(written(tmp_path, text)) == plan
    assert len(told) == 4 and "benchmark.toml: limit is deprecated" in "".join(str(one.message) for one in told)
    with pytest.raises(SettingsError, match="corruptions and corruption are the same; leave out corruptions"):
        read_benchmark(written(tmp_path, 'corruptions = ["fog"]\n' + GOOD))


def test_rows_are_the_product_and_the_sweeps(tmp_path: Path) -> None:
    cases = cases_of(read_benchmark(written(tmp_path)))
    assert len(set(cases)) == len(cases)
    # 3 detectors x (clean + 2 corruptions x 2 severities) x 2 channels; 2 detectors x (2 numbers of agents + 1 error).
    assert len(cases) == 3 * 5 * 2 + 2 * 3
    assert {case.condition for case in cases if case.method == "Late"} == {
        Condition(),
        *(Condition(kind, level) for kind in ("fog", "snow") for level in (1, 3)),
    }
    swept = [case for case in cases if case.pose_error]
    assert [(case.method, case.training, case.pose_error) for case in swept] == [("DSRC", 0, 0.2), ("DSRC", 1, 0.2)]
    spec = swept[0].spec()
    assert (spec.position_error_m, spec.heading_error_deg, spec.medium) == (0.2, 0.2, "perfect")


def test_paths_are_taken_from_the_files_folder_first(tmp_path: Path) -> None:
    (tmp_path / "a.pt").write_bytes(b"")
    plan = read_benchmark(written(tmp_path))
    assert plan.methods[0].detectors == (str(tmp_path / "a.pt"), "b.pt")


PAIR = """
[[differences]]
method = "DSRC"
baseline = "Late"

[[notes]]
methods = ["Late", "DSRC"]
text = "Old."

[sweeps]"""


def test_who_is_corrupted_is_part_of_every_condition(tmp_path: Path) -> None:
    text = GOOD.replace('name = "small"', 'name = "small"\ncorrupted_agents = "helpers"')
    plan = read_benchmark(written(tmp_path, text))
    assert {case.condition.agents for case in cases_of(plan) if case.condition.kind != "clean"} == {"helpers"}
    options = BenchmarkOptions(checkpoint=("c.pt",), data=("data",), corrupted_agents="1002,-1")
    assert plan_of(options).corrupted_agents == "1002,-1"
    for who, message in (
        ("helper", "corrupted_agents: expected all, ego, helpers, vehicles, roadside or ids"),
        ("ego", "pose_error.* expected helpers"),
    ):
        wrong = GOOD.replace('name = "small"', f'name = "small"\ncorrupted_agents = "{who}"').replace(
            '"snow"]', '"pose_error"]'
        )
        with pytest.raises(SettingsError, match=message):
            read_benchmark(written(tmp_path, wrong))


def test_both_families_are_run_and_clean_frames_once(tmp_path: Path) -> None:
    text = GOOD.replace('name = "small"', 'name = "small"\nfamily = ["physical", "paper"]')
    plan = read_benchmark(written(tmp_path, text))
    conditions = {case.condition for case in cases_of(plan) if case.method == "Late"}
    corrupted = {
        Condition(kind, level, family)
        for kind in ("fog", "snow")
        for level in (1, 3)
        for family in ("physical", "paper")
    }
    assert conditions == {Condition(), *corrupted}
    lacking = text.replace('"snow"]', '"spray"]')
    with pytest.raises(SettingsError, match=r"corruptions: .*spray"):
        read_benchmark(written(tmp_path, lacking))
    options = BenchmarkOptions(checkpoint=("c.pt",), data=("data",), family=("paper",))
    assert plan_of(options).family == ("paper",)
    with pytest.raises(SettingsError, match="leave out --family"):
        plan_of(BenchmarkOptions(plan=written(tmp_path), family=("paper",)))


def test_differences_and_notes_of_missing_methods_are_left_out(tmp_path: Path) -> None:
    plan = read_benchmark(written(tmp_path, GOOD.replace("[sweeps]", PAIR)))
    assert (plan.differences[0].method, plan.differences[0].baseline) == ("DSRC", "Late")
    (tmp_path / "a.pt").write_bytes(b"")
    part, _ = available(read_benchmark(tmp_path / "benchmark.toml"))
    assert part.differences == () and [note.methods for note in part.notes] == [("DSRC",)]
    (tmp_path / "c.pt").write_bytes(b"")
    part, _ = available(read_benchmark(tmp_path / "benchmark.toml"))
    assert part.differences == plan.differences and part.notes == plan.notes


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("[sweeps]", PAIR.replace('baseline = "Late"', 'baseline = "Lat"'), ["differences.baseline", "Lat", "'Late'"]),
        ("[sweeps]", PAIR.replace('baseline = "Late"', 'baseline = "DSRC"'), ["differences[0].baseline", "another"]),
        ("[sweeps]", PAIR.partition("[[notes]]")[0] + PAIR, ["differences[1]", "DSRC and Late again"]),
        ("[sweeps]", PAIR.replace('"Late", "DSRC"]', '"Lte"]'), ["notes.methods", "Lte", "did you mean 'Late'"]),
        ("frames = 10", 'family = ["paper", "paper"]', ["family", "names that differ", "paper"]),
        ('"snow"]', '"snwo"]', ["corruptions", "snwo", "did you mean 'snow'"]),
        ("severity = [1, 3]", "severity = [6]", ["severity", "1 to 5", "6"]),
        ("severity = [1, 3]", "severity = []", ["severity", "at least one", "none"]),
        (
            "severity = [1, 3]",
            'severity = [1]\ncorrupted_agents = "me"',
            ["corrupted_agents", "all, ego, helpers", "me"],
        ),
        ("severity = [1, 3]", "severity = [3, 3]", ["severity", "names that differ", "3"]),
        ('"its-g5-6"]', '"its-g5-7"]', ["channel", "its-g5-7", "did you mean"]),
        ('name = "Late"', 'name = "DSRC"', ["methods", "names that differ", "DSRC"]),
        ('name = "Late"', 'nam = "Late"', ["methods[1]", "nam", "did you mean 'name'"]),
        ('["c.pt"]', "[]", ["methods[1].detectors"]),
        ('["c.pt"]', '["c.pt"]\nuse = {shar = 0.1}', ["methods.Late.use", "shar", "did you mean 'share'"]),
        ('["c.pt"]', '["c.pt"]\nuse = {share = "a"}', ["methods.Late.use.share", "expected float", "found a"]),
        ('["c.pt"]', '["c.pt"]\nuse = {nms_iou = -3}', ["methods.Late.use.nms_iou", ">= 0.0", "found -3"]),
        ("frames = 10", "frames = 0", ["frames", "at least 1"]),
        ("frames = 10", 'frames = "ten"', ["frames", "int", "ten"]),
        ("frames = 10", "seed = -1", ["seed", "at least 0"]),
        ('methods = ["DSRC"]', 'methods = ["DSCR"]', ["sweeps.methods", "DSCR", "did you mean 'DSRC'"]),
        ("agents = [1, 2]", "agents = [0]", ["sweeps.agents[0]", ">= 1"]),
        ("agents = [1, 2]", "loss = [1.5]", ["sweeps.loss[0]", "<= 1"]),
        ("[sweeps]", "[sweep]", ["sweep", "did you mean 'sweeps'"]),
        ("[[datasets]]", "[[data]]", ["data", "did you mean 'datasets'"]),
        ('name = "small"', 'name = "small', ["not a readable TOML file"]),
        ('name = "small"', 'family = ["papers"]', ["family[0]", "papers"]),
        ('"snow"]', '"snwo"]', ["toml: corruptions: expected a corruption"]),
    ],
)
def test_a_mistake_is_one_line_with_its_place(tmp_path: Path, old: str, new: str, words: list[str]) -> None:
    assert old in GOOD
    path = written(tmp_path, GOOD.replace(old, new))
    with pytest.raises(SettingsError) as caught:
        read_benchmark(path)
    text = str(caught.value)
    assert "\n" not in text and str(path) in text
    assert all(word in text for word in words), text


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match=r"none\.toml: file not found; expected a TOML file$"):
        read_benchmark(tmp_path / "none.toml")


def test_flags_say_the_same_as_a_file(tmp_path: Path) -> None:
    plan = plan_of(
        BenchmarkOptions(
            checkpoint=("DSRC=a.pt", "DSRC=b.pt", "Late=c.pt"),
            data=("test=data",),
            corruption=("fog", "snow"),
            severity=(1, 3),
            channel=("ideal", "its-g5-6"),
            agents=(1, 2),
            pose_error=(0.0, 0.2),
            frames=10,
        )
    )
    assert plan.methods == read_benchmark(written(tmp_path)).methods
    assert len(cases_of(plan)) == 3 * 5 * 2 + 3 * 3
    assert plan_of(BenchmarkOptions(plan=written(tmp_path))) == read_benchmark(written(tmp_path))
    unnamed = plan_of(BenchmarkOptions(checkpoint=("runs/c.pt",), data=("data/test",)))
    assert (unnamed.methods[0].name, unnamed.datasets[0].name) == ("c", "test")


def test_only_files_that_were_given_one_name_are_trainings_of_one_method() -> None:
    def plan(checkpoints: tuple[str, ...], data: tuple[str, ...] = ("test",)) -> Benchmark:
        return plan_of(BenchmarkOptions(checkpoint=checkpoints, data=data))

    apart = plan(("runs/a/detector.pt", "runs/b/detector.pt"), ("one/test", "two/test"))
    assert {m.name: m.detectors for m in apart.methods} == {
        "a/detector": ("runs/a/detector.pt",),
        "b/detector": ("runs/b/detector.pt",),
    }
    assert [d.name for d in apart.datasets] == ["one/test", "two/test"]
    pooled = plan(("x=runs/a/detector.pt", "x=runs/b/detector.pt"))
    assert len(pooled.methods) == 1 and len(pooled.methods[0].detectors) == 2
    for pair in (("a/student/d.pt", "b/student/d.pt"), ("d=a.pt", "b/d.pt")):
        with pytest.raises(SettingsError, match=r"checkpoint: expected names that differ.*name=path"):
            plan(pair)


def test_a_folder_with_an_equals_sign_is_no_name() -> None:
    checkpoints = ("runs/lr=0.1/c.pt", "slow=runs/lr=0.01/c.pt")
    plan = plan_of(BenchmarkOptions(checkpoint=checkpoints, data=("data/n=3/test",)))
    assert [(m.name, m.detectors[0]) for m in plan.methods] == [
        ("c", "runs/lr=0.1/c.pt"),
        ("slow", "runs/lr=0.01/c.pt"),
    ]
    assert (plan.datasets[0].name, plan.datasets[0].drives) == ("test", ("data/n=3/test",))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"plan": "file", "frames": 5}, r"describes the benchmark; leave out --frames"),
        ({"plan": "file", "data": ("data",)}, "leave out --data"),
        ({"plan": "file", "checkpoint": ("a.pt",)}, "leave out --checkpoint"),
        ({"plan": "a.pt"}, "plan: expected a .toml, found .*a.pt; detector files go after --checkpoint"),
        ({"data": ("data",)}, "nothing to compare; add --checkpoint"),
        ({"checkpoint": ("a.pt",)}, "nothing to compare; add --data"),
        ({"checkpoint": ("a.pt",), "data": ("data",), "agents": (0,)}, "agents"),
    ],
)
def test_a_file_or_options_describe_a_benchmark_never_both(
    tmp_path: Path, options: dict[str, Any], message: str
) -> None:
    if "plan" in options:
        options = {**options, "plan": written(tmp_path) if options["plan"] == "file" else tmp_path / options["plan"]}
    with pytest.raises(SettingsError, match=message):
        plan_of(BenchmarkOptions(**options))


def test_missing_detectors_can_be_left_out(tmp_path: Path) -> None:
    (tmp_path / "b.pt").write_bytes(b"")
    plan = read_benchmark(written(tmp_path, GOOD))
    part, absent = available(plan)
    assert [(method.name, method.detectors) for method in part.methods] == [("DSRC", (str(tmp_path / "b.pt"),))]
    assert absent == ["a.pt", "c.pt"]
    assert part.sweeps == plan.sweeps
    (tmp_path / "b.pt").rename(tmp_path / "c.pt")
    other, _ = available(read_benchmark(written(tmp_path)))
    # Only DSRC was to be swept: without it nothing is, rather than everything.
    assert [case for case in cases_of(other) if case.agents or case.pose_error] == []
    (tmp_path / "c.pt").unlink()
    with pytest.raises(SettingsError, match="at least one detector that is there"):
        available(read_benchmark(written(tmp_path)))


def test_the_projects_own_benchmark_has_all_that_the_papers_tables_need() -> None:
    plan = read_benchmark(SHIPPED)
    runs = {Path(path).parts[1].rpartition("_s")[0] for method in plan.methods for path in method.detectors}
    assert set(METHODS) <= runs
    parts, otherwise = (
        {"sdd", "pcp", "sdd-pcp"},
        {f"dsrc-{name}" for name in ("thinned", "corrupted", "consistent", "directed", "lifted")}
        | {"attfuse-corrupted"},
    )
    assert runs - set(METHODS) == parts | otherwise
    trainings = {method.name: len(method.detectors) for method in plan.methods}
    assert trainings["DSRC"] == trainings["AttFuse (plain student)"] == 5 and trainings["Where2comm"] == 3
    # The document has a place for every block, so that what people write stays where it is.
    text = SHIPPED.with_name("report.md").read_text(encoding="utf-8")
    sweeps = [field for field in ("agents", "pose_error", "delay_s", "loss") if getattr(plan.sweeps, field)]
    tables = ["table_1", "table_1_opencood", "table_2", "table_3", "table_4", "visibility", *sweeps]
    for name in (*tables, "differences", "figure_4", "figure_5", "figure_6", "figure_8", "traffic"):
        for word in ("begin", "end"):
            assert text.count(f"<!-- {word} {plan.name}/{plan.datasets[0].name}/{name} -->") == 1
