"""The Python interface: fast to import, complete, documented, and the same for type checkers."""

import ast
import inspect
import subprocess
import sys
from pathlib import Path

import pytest

import dsrc
from tests.paths import ROOT


def test_importing_dsrc_imports_no_other_distribution() -> None:
    code = "import sys; before = set(sys.modules); import dsrc; print(*sorted(set(sys.modules) - before))"
    run = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    found = {name for name in run.stdout.split() if name.split(".")[0] not in sys.stdlib_module_names}
    assert found == {"dsrc", "dsrc.hidden", "dsrc.outputs", "sim", "sim.errors", "sim.files"}


@pytest.mark.parametrize("name", dsrc.__all__)
def test_a_name_resolves_and_is_documented(name: str) -> None:
    first = (inspect.getdoc(getattr(dsrc, name)) or "").partition("\n")[0]
    words = first.split()
    assert len(words) >= 3, name
    assert words[0] not in ("What", "Whether", "How", "Who"), f"{name}: {first}"
    assert first.endswith((".", ":")) or len(first) > 60, f"{name}: {first}"


def test_type_checkers_and_the_program_see_the_same_names() -> None:
    tree = ast.parse(Path(str(dsrc.__file__)).read_text(encoding="utf-8"))
    typed = next(node for node in tree.body if isinstance(node, ast.If))
    imports = [node for node in typed.body if isinstance(node, ast.ImportFrom)]
    seen = {str(node.module): tuple(sorted(alias.name for alias in node.names)) for node in imports}
    assert seen == {module: tuple(sorted(names)) for module, names in dsrc._MODULES.items()}
    assert sorted(dsrc.__all__) == sorted(dsrc._HOME)
    assert set(dsrc.__all__) <= set(dir(dsrc))


def test_an_unknown_name_is_an_attribute_error() -> None:
    with pytest.raises(AttributeError, match="no attribute 'open_drive_'"):
        _ = dsrc.open_drive_


@pytest.mark.parametrize("package", ["dsrc", "sensors", "sim"])
def test_a_package_is_marked_as_typed(package: str) -> None:
    assert (ROOT / package / "py.typed").is_file()
    assert f'{package} = ["py.typed"' in (ROOT / "pyproject.toml").read_text(encoding="utf-8")
