"""Studies: each says how it is used, and is in no package."""

import ast
from pathlib import Path

import pytest

from tests.commands import run_study
from tests.paths import ROOT

SCRIPTS = [path for path in (ROOT / "studies").glob("*/*.py") if "__main__" in path.read_text().splitlines()[-2]]
STUDIES = sorted(path.relative_to(ROOT / "studies") for path in SCRIPTS)


@pytest.mark.parametrize("script", STUDIES, ids=str)
def test_a_study_says_what_it_is_and_how_to_use_it(script: Path) -> None:
    name = ".".join(script.with_suffix("").parts)
    text = ast.get_docstring(ast.parse((ROOT / "studies" / script).read_text())) or ""
    command = f"python -m studies.{name.removesuffix('.__main__')}"
    assert f"Usage:\n    {command}" in text
    assert f"{command} " in (ROOT / "studies/README.md").read_text().replace("`", " ")
    assert "usage:" in run_study(name, "--help").stdout
