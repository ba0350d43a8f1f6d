"""The hash of a cell's code covers every module and table that decides its numbers, and no other."""

import importlib
import shutil
import sys
from functools import partial
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest

from sim.kept.code_hash import code_files, code_hash, own_code_hash, package_versions, versions_with
from tests.paths import ROOT

CELLS = "dsrc.evaluation.cells"


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("tree")
    for package in ("sim", "sensors", "dsrc"):
        shutil.copytree(ROOT / package, root / package, ignore=shutil.ignore_patterns("__pycache__", "*.pt"))
    return root


def edited(tree: Path, name: str) -> str:
    """Return the hash of a tree with one line more in a file, which is put back."""
    path = tree / name
    before = path.read_bytes()
    path.write_bytes(before + b"\nA_LINE_MORE = 1\n")
    try:
        return code_hash.__wrapped__(CELLS, tree)
    finally:
        path.write_bytes(before)


FAR = (
    "sim/boxes.py",
    "sim/geometry.py",
    "sim/radio/channel.py",
    "sensors/sweep.py",
    "sensors/frame.py",
    "sensors/optics/reflectance.py",
    "sensors/corruptions/physics/medium.py",
    "sensors/presets/tables/vlp-16.csv",
    "dsrc/data/points_in_boxes.py",
    "dsrc/data/formats/pcd.py",
    "dsrc/data/sample.py",
    "dsrc/models/inputs/batch.py",
    "dsrc/models/fusion/where2comm.py",
    "dsrc/models/storage/deploy.py",
    "dsrc/ops/iou.py",
    "dsrc/evaluation/metrics/matching.py",
    "dsrc/evaluation/detect.py",
)
OTHER = (
    "dsrc/__init__.py",
    "dsrc/review/state.py",
    "dsrc/cli/main.py",
    "dsrc/runs/executors.py",
    "dsrc/runs/study.py",
    "dsrc/training/train.py",
    "dsrc/evaluation/figures/bars.py",
    "dsrc/evaluation/report/report.py",
    "dsrc/checkpoints/README.md",
    "sim/traffic/sumo/traffic.py",
)


def test_an_edit_of_what_decides_a_number_changes_the_hash_and_no_other_does(tree: Path) -> None:
    whole = code_hash.__wrapped__(CELLS, tree)
    assert whole == code_hash.__wrapped__(CELLS, ROOT)
    assert len({edited(tree, name) for name in FAR} | {whole}) == len(FAR) + 1
    assert {edited(tree, name) for name in OTHER} == {whole}
    assert code_hash.__wrapped__(CELLS, tree) == whole


def test_imports_inside_functions_count_and_those_of_type_checkers_do_not(tmp_path: Path) -> None:
    sources = {
        "dsrc/evaluation/cells.py": "from sim import near\ndef f():\n    from ..ops.far import g\n",
        "dsrc/evaluation/other.py": "",
        "dsrc/ops/__init__.py": "import_module('dsrc.ops.named')\n",
        "dsrc/ops/far.py": "if TYPE_CHECKING:\n    import dsrc.ops.types\n",
        "dsrc/ops/named.py": "import numpy\n",
        "dsrc/ops/types.py": "",
        "dsrc/ops/tables/a.csv": "1",
        "dsrc/ops/cache/code.py": "",
        "sim/near.py": "",
        "sim/__init__.py": "import sim.unused\n",
        "sim/unused.py": "",
    }
    for name, text in sources.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    found = {path.relative_to(tmp_path).as_posix() for path in code_files(CELLS, tmp_path)}
    wanted = {"cells", "ops/__init__", "ops/far", "ops/named", "ops/tables/a", "near"}
    names = {
        name for name in sources if name.rpartition(".")[0].partition("/")[2].removeprefix("evaluation/") in wanted
    }
    assert found == names and len(names) == len(wanted)
    assert set(package_versions.__wrapped__(CELLS, tmp_path)) == {"numpy"}


def test_the_code_of_a_user_counts_and_ours_is_counted_already(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "haze_alone.py").write_text("def haze():\n    return 1\n")
    (tmp_path / "haze_whole").mkdir()
    (tmp_path / "haze_whole/__init__.py").write_text("from haze_whole.parts import haze\n")
    (tmp_path / "haze_whole/parts.py").write_text("def haze():\n    return 1\n")
    for name, file in (("haze_alone", "haze_alone.py"), ("haze_whole", "haze_whole/__init__.py")):
        haze = importlib.import_module(name).haze
        before = own_code_hash.__wrapped__(haze)
        assert before and own_code_hash.__wrapped__(haze) == before
        assert before in versions_with(CELLS, haze, code_hash.__wrapped__).values()
        (tmp_path / file).write_text((tmp_path / file).read_text() + "OTHER = 1\n")
        assert own_code_hash.__wrapped__(haze) != before
        monkeypatch.delitem(sys.modules, name)
    assert own_code_hash(code_files) == ""
    assert own_code_hash.__wrapped__(partial(code_files, root=tmp_path)) == ""
    assert own_code_hash.__wrapped__(partial(haze, k=1)) != own_code_hash.__wrapped__(partial(haze, k=2)) != before
    here: dict = {"__name__": "nowhere"}
    exec("def haze(): pass", here)
    assert own_code_hash.__wrapped__(here["haze"]) != own_code_hash.__wrapped__(here["haze"])  # no source: never served


def test_versions_of_packages_that_compute_are_listed() -> None:
    assert {"numpy", "torch", "numba", "scipy", "powerboxes"} <= set(package_versions(CELLS))
    assert not {"rich", "tyro", "matplotlib", "viser"} & set(package_versions(CELLS))
    # Nothing imports these: one is called as a program, the other by trimesh.
    assert {"eclipse-sumo", "mapbox_earcut"} <= set(package_versions("sim.world.build"))


def test_cells_are_computed_where_sumo_is_not_installed(monkeypatch: pytest.MonkeyPatch) -> None:
    known = {
        name: several for name, several in packages_distributions().items() if name not in ("sumo", "mapbox_earcut")
    }
    monkeypatch.setattr("sim.kept.code_hash.packages_distributions", lambda: known)
    found = package_versions.__wrapped__(CELLS)
    assert "numpy" in found and not {"eclipse-sumo", "mapbox_earcut"} & set(found)
