"""A user's own `sim` or `sensors` that hides ours is named in one line."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.paths import ROOT


def imported(here: Path) -> subprocess.CompletedProcess[str]:
    """Import dsrc from a folder."""
    own = os.environ | {"PYTHONPATH": str(ROOT)}
    return subprocess.run([sys.executable, "-c", "import dsrc"], cwd=here, env=own, capture_output=True, text=True)


@pytest.mark.parametrize("name", ["sim/__init__.py", "sensors/__init__.py", "sensors.py"])
def test_what_hides_a_package_of_ours_is_named(tmp_path: Path, name: str) -> None:
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text("")
    last = imported(tmp_path).stderr.splitlines()[-1]
    shadow = tmp_path / name.removesuffix("/__init__.py")
    assert last.startswith("ImportError: dsrc needs its own package") and f"which {shadow} hides" in last


def test_a_folder_of_data_hides_nothing(tmp_path: Path) -> None:
    (tmp_path / "sim").mkdir()
    (tmp_path / "sim" / "data.csv").write_text("")
    assert imported(tmp_path).returncode == 0
