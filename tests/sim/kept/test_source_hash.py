"""What a source computes has one hash, however it is commented, documented and annotated."""

import subprocess
from pathlib import Path
from shutil import which

import pytest

from sim.kept.source_hash import source_hash
from tests.paths import ROOT

SOURCE = '''"""Brakes."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from somewhere import Road


class Brake(Struct):
    """Brake of a car.

    Attributes:
        force: N.
    """

    force: float = 8.0

    def stop_m(self, speed: float) -> float:
        """Return the distance, m."""
        # Newton's law.
        energy: float = 0.5 * speed**2
        return energy / self.force

    @register
    def heat(self, speed: int) -> str:
        return f"{speed:.{2}f}" f" J, {speed=}"
'''

SAME = {
    "comment": ("# Newton's law.", "# Newton, 1687."),
    "docstring of a module": ("Brakes.", "Breaks."),
    "docstring of a class": ("force: N.", "force: of the brake, N."),
    "docstring of a function": ('"""Return the distance, m."""', "pass"),
    "annotation of a parameter": ("speed: float", "speed"),
    "annotation of what is returned": (" -> float", ""),
    "annotation of a variable": ("energy: float =", "energy ="),
    "import for type checkers": ("import Road", "import Road, Lane"),
    "blank lines and brackets": ("return energy / self.force", "\n\n        return (energy / self.force)"),
    "digits": ("8.0", "8.00"),
    "parts of a text": ('{2}f}" f" J', "{2}f} J"),
}
OTHER = {
    "value": ("0.5", "0.25"),
    "type of a value": ("speed**2", "speed**2.0"),
    "name": ("speed: float", "pace: float"),
    "operator": ("energy /", "energy //"),
    "statement": ("        return energy", "        energy += 1\n        return energy"),
    "annotation of a field": ("force: float", "force: int"),
    "field without a value": ("    force: float = 8.0", "    mass: float\n    force: float = 8.0"),
    "annotation that a decorator may read": ("speed: int", "speed: float"),
    "digits of a text": (".{2}f", ".{3}f"),
    "text that names its value": ("{speed=}", "{speed}"),
    "string that is used": ("return energy / self.force", "return 'Brakes.'"),
}


def edited(change: tuple[str, str]) -> bytes:
    assert change[0] in SOURCE
    return SOURCE.replace(*change).encode()


@pytest.mark.parametrize("what", SAME)
def test_what_computes_nothing_changes_no_hash(what: str) -> None:
    assert source_hash(edited(SAME[what])) == source_hash(SOURCE.encode())


@pytest.mark.parametrize("what", OTHER)
def test_what_computes_changes_the_hash(what: str) -> None:
    assert source_hash(edited(OTHER[what])) != source_hash(SOURCE.encode())


def test_what_is_no_python_counts_by_its_bytes() -> None:
    assert source_hash(b"def (") == source_hash(b"def (") != source_hash(b"def ( ")


@pytest.mark.parametrize("python", ["python3.11", "python3.12", "python3.13"])
def test_every_python_gives_the_same_hash(python: str, tmp_path: Path) -> None:
    program = which(python)
    if program is None or subprocess.run([program, "-c", ""], capture_output=True).returncode:
        pytest.skip(f"{python} is not installed")
    (tmp_path / "brake.py").write_text(SOURCE)
    files = [tmp_path / "brake.py", ROOT / "sim/scenario.py", ROOT / "sim/errors.py"]
    code = (
        "import sys; from pathlib import Path; from sim.kept.source_hash import source_hash\n"
        "for name in sys.argv[1:]: print(source_hash(Path(name).read_bytes()))"
    )
    done = subprocess.run([program, "-c", code, *map(str, files)], capture_output=True, text=True, check=True, cwd=ROOT)
    assert done.stdout.split() == [source_hash(path.read_bytes()) for path in files]
