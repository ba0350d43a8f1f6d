"""Compiled loops: their cache on disk outlives edits of their source."""

import os
import subprocess
import sys
from pathlib import Path

from tests.paths import ROOT

SOURCE = """
import logging
from typing import NamedTuple
from sensors.compiled import compiled

logging.basicConfig(level=logging.INFO)

class {name}(NamedTuple):
    value: float

@compiled()
def value_of(given):
    return given.value

print(value_of({name}({value})), sum(value_of.stats.cache_hits.values()))
"""


def output(folder: Path, name: str, value: float) -> list[str]:
    (folder / "loop.py").write_text(SOURCE.format(name=name, value=value))
    kept = {key: text for key, text in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    run = [sys.executable, "-c", "import loop"]
    env = {**kept, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}", "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run(run, env=env, cwd=folder, capture_output=True, text=True, check=True)
    return [*done.stdout.split(), *(["said"] if "compiling loops" in done.stderr else [])]


def test_a_renamed_type_compiles_anew_and_an_unchanged_source_does_not(tmp_path: Path) -> None:
    assert output(tmp_path, "Old", 1.0) == ["1.0", "0", "said"]
    assert output(tmp_path, "Old", 1.0) == ["1.0", "1"]
    assert output(tmp_path, "New", 1.0) == ["1.0", "0", "said"]
