"""What a source computes has one hash, however it is commented, documented and annotated."""

import pytest

from sim.kept.source_hash import source_file_hash, source_hash

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
    "quotes": ("8.0", "8.00"),
}
OTHER = {
    "value": ("0.5", "0.25"),
    "type of a value": ("speed**2", "speed**2.0"),
    "name": ("speed: float", "pace: float"),
    "operator": ("energy /", "energy //"),
    "statement": ("        return energy", "        energy += 1\n        return energy"),
    "annotation of a field": ("force: float", "force: int"),
    "field without a value": ("    force: float = 8.0", "    mass: float\n    force: float = 8.0"),
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


def test_the_hash_is_the_same_on_every_python() -> None:
    assert source_hash(SOURCE.encode()) == "31d85529ebbd74baf6c1a588d860512c01c9e3c085cda99f940e85d1e767c565"


def test_a_file_that_changes_has_another_hash(tmp_path) -> None:
    file = tmp_path / "brake.py"
    file.write_text("a = 1\n")
    before = source_file_hash(file)
    file.write_text("a = 22\n")
    assert source_file_hash(file) != before
