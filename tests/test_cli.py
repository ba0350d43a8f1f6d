"""The command line answers at once and says in one line what is wrong."""

import subprocess
import sys
from pathlib import Path

HEAVY = {"torch", "libsumo", "trimesh", "viser", "matplotlib", "scipy", "gymnasium", "embreex", "shapely"}


def dsrc(*args: str) -> subprocess.CompletedProcess[str]:
    """Run the command line in its own process."""
    return subprocess.run([sys.executable, "-m", "dsrc", *args], capture_output=True, text=True, timeout=120)


def assert_one_line(result: subprocess.CompletedProcess[str], *words: str) -> None:
    """A user's mistake: exit code 2, one line on standard error, no stack trace."""
    assert result.returncode == 2, result.stderr
    lines = result.stderr.strip().splitlines()
    assert len(lines) == 1, result.stderr
    assert all(word in lines[0] for word in words), lines[0]


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys\n"
        "from dsrc.cli.main import run\n"
        "try:\n    run(['--help'])\nexcept SystemExit:\n    pass\n"
        f"heavy = {HEAVY} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert result.returncode == 0, result.stderr


def test_every_verb_has_help() -> None:
    made = ("scenarios", "generate", "render", "data", "corrupt", "convert")
    for verb in (*made, "train", "verify", "export", "evaluate", "benchmark", "view", "drive", "demo"):
        result = dsrc(verb, "--help")
        assert result.returncode == 0
        assert "usage: dsrc" in result.stdout


def test_an_unknown_scenario_names_the_nearest(tmp_path: Path) -> None:
    assert_one_line(dsrc("generate", "braunschwieg", "--out", str(tmp_path / "x")), "braunschwieg", "braunschweig")


def test_what_is_wrong_with_a_data_set_is_listed_and_costs_exit_code_2(tmp_path: Path) -> None:
    (tmp_path / "drive" / "1").mkdir(parents=True)
    (tmp_path / "drive" / "1" / "000000.yaml").write_text("vehicles: [")
    result = dsrc("data", "check", str(tmp_path))
    assert_one_line(result, "things are wrong")
    assert "000000.pcd: file is missing" in result.stdout and "000000.yaml" in result.stdout


def test_a_data_set_takes_its_settings_from_its_toml(tmp_path: Path) -> None:
    out = ("--out", str(tmp_path / "x"))
    assert_one_line(dsrc("generate", "dsrc-sim", "--frames", "3", *out), "frames", "TOML")
    assert_one_line(dsrc("generate", "dsrc-sim", "--splits", "tset", *out), "split", "'test'")
    assert_one_line(dsrc("generate", "four_way", "--executor", "ray", *out), "source", "splits")
    assert_one_line(dsrc("generate", "dsrc-sim"), "out")
    assert_one_line(dsrc("render", str(tmp_path / "none"), *out), "traffic.npz", "no such folder")
    assert not (tmp_path / "x").exists()


def test_an_empty_folder_is_not_a_dataset(tmp_path: Path) -> None:
    assert_one_line(dsrc("view", str(tmp_path), "--export", str(tmp_path / "x.html")), str(tmp_path))


def test_a_checkpoint_that_is_none_is_named(tmp_path: Path) -> None:
    path = tmp_path / "model.pt"
    path.write_bytes(b"not a checkpoint")
    assert_one_line(dsrc("drive", "four_way", "--perception", "ego", "--checkpoint", str(path)), "model.pt")


def test_a_benchmark_says_what_is_wrong_with_its_file(tmp_path: Path) -> None:
    path = tmp_path / "benchmark.toml"
    path.write_text('[[methods]]\nname = "DSRC"\ndetectors = ["none.pt"]\n[[datasets]]\nname = "x"\ndrives = ["y"]\n')
    out = ("--out", str(tmp_path / "out"))
    assert_one_line(dsrc("benchmark", str(path), *out), "none.pt", "no such checkpoint")
    assert_one_line(dsrc("benchmark", str(path), *out, "--limit", "3"), "limit", "describes the benchmark")
    path.write_text(path.read_text().replace("detectors", "detector"))
    assert_one_line(dsrc("benchmark", str(path), *out), str(path), "did you mean 'detectors'")
    assert not (tmp_path / "out").exists()
