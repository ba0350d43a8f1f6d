"""docs/architecture.md: its folders, terms and walks are those of the code."""

import ast
import re

import dsrc
from tests.paths import ROOT
from tests.test_imports import FULL, MODULES, imported

PAGE = (ROOT / "docs/architecture.md").read_text(encoding="utf-8")


def section(title: str) -> str:
    """Text below a heading."""
    return PAGE.split(f"\n## {title}\n")[1].split("\n## ")[0]


def test_every_folder_is_listed() -> None:
    listed = set(re.findall(r"^\| `([\w/]+)/` \|", section("Folders"), re.MULTILINE))
    folders = {path.parent.relative_to(ROOT).as_posix() for path in MODULES.values()}
    top = {folder for folder in folders if folder.count("/") <= 1}
    assert top <= listed
    assert all((ROOT / folder).is_dir() for folder in listed)
    for folder in FULL:
        assert f"`{folder}`" in section("Folders")


def test_every_term_is_a_class_of_its_module() -> None:
    rows = re.findall(r"^\| `(\w+)` \| `([\w.]+)` \|", section("Terms"), re.MULTILINE)
    assert len(rows) >= 25
    for name, module in rows:
        tree = ast.parse(MODULES[module].read_text(encoding="utf-8"))
        assert name in {node.name for node in tree.body if isinstance(node, ast.ClassDef)}, f"{module}.{name}"


def test_paths_and_names_of_the_interface_exist() -> None:
    for path in re.findall(r"`((?:sim|sensors|dsrc|tests|scenarios)/[\w/.]*)`", PAGE):
        assert (ROOT / path).exists(), path
    for name in re.findall(r"`dsrc\.(\w+)", PAGE):
        assert name in {*dsrc.__all__, "__all__", "scenarios", "sensors", "corruptions", "fusions"} or any(
            module.startswith(f"dsrc.{name}.") for module in MODULES
        ), name


def test_a_walk_has_at_most_six_modules_that_reach_each_other() -> None:
    walks = re.findall(r"^\* `dsrc ([\w ]+)`: (.*?)(?=\n\* |\Z)", section("Walks"), re.MULTILINE | re.DOTALL)
    assert [name for name, _ in walks] == ["generate", "corrupt", "model train", "evaluate", "view", "drive"]
    for name, text in walks:
        steps = re.findall(r"`([\w/]+)\.py`", text.split(". ")[0].replace(".\n", ". "))
        assert 3 <= len(steps) <= 6, name
        modules = [step.replace("/", ".") for step in steps]
        for number, module in enumerate(modules[1:], 1):
            before = set().union(*(imported()[earlier]["ours"] for earlier in modules[:number]))
            packages = {other.rpartition(".")[0] for other in before}
            assert module in before or module.rpartition(".")[0] in before | packages, f"{name}: {module}"
