"""Files of the distribution: beside its folder in a clone, inside it in a source distribution."""

from pathlib import Path

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PARTS = (
    "sim",
    "sensors",
    "dsrc/__init__.py",
    "dsrc/hidden.py",
    "dsrc/outputs.py",
    "dsrc/py.typed",
    "dsrc/data",
    "dsrc/ops",
    "dsrc/options",
    "dsrc/runs",
    "dsrc/tables",
)


class Parts(BuildHookInterface):
    """Include `PARTS` in wheels and source distributions."""

    def initialize(self, version: str, build_data: dict) -> None:
        """See hatchling."""
        here = Path(self.root)
        source = here if (here / "sim").is_dir() else here.parents[1]
        build_data["force_include"] |= {str(source / part): part for part in PARTS}
