"""Our packages that a folder or a file of the user's hides are told by name, before an import of theirs fails."""

from importlib.util import find_spec
from os import path

_OURS = path.dirname(path.dirname(path.abspath(__file__)))

for _name in ("sim", "sensors"):
    _found = find_spec(_name)
    if _found is None or _found.origin is None:
        continue
    if not path.samefile(path.dirname(_found.origin), path.join(_OURS, _name)):
        _place = _found.origin.removesuffix(f"{path.sep}__init__.py")
        raise ImportError(f"dsrc needs its own package '{_name}', which {_place} hides; rename it or start elsewhere")
