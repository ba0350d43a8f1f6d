"""Classes of one's own by `module:Class`: imported, made without arguments, known by their source."""

import hashlib
import inspect
import os
import sys
import uuid
from dataclasses import fields
from functools import cache
from importlib import import_module
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from dsrc.data.sample import DetectorSettings, Sample, SampleRequest
from dsrc.detectors.answers import checked
from dsrc.detectors.texts import SHIPPED_DETECTOR
from dsrc.ops.detections import Detections
from sim.boxes import CLASSES, VEHICLES
from sim.errors import SettingsError, complaint, raised_text, warn_deprecated
from sim.kept.code_hash import sources_hash

_NO_SOURCE = uuid.uuid4().hex
_IMPORTED: dict[str, tuple[ModuleSpec | None, str]] = {}
"""Spec and `source_hash` of imported modules of one's own: Python keeps what it has imported, whatever becomes of the
file, until it is loaded again, which gives it another spec."""


class OwnDetector:
    """Detector of one's own: what it finds is checked, and its settings are completed.

    Args:
        detector: with `detect(sample) -> Detections`; without `settings` its samples are made as for the shipped
            detector.
        name: in messages.

    Attributes:
        settings: rules of its samples.
        classes: of what it detects; those that it names, else vehicles.
        name: of its class.
    """

    def __init__(self, detector: Any, name: str = "") -> None:
        self.settings: DetectorSettings
        self.name = type(detector).__name__
        self._detector, self._where = detector, name or self.name
        self.classes: tuple[str, ...] = getattr(detector, "classes", VEHICLES)
        settings = getattr(detector, "settings", None)
        if settings is None:
            self.settings = _shipped_request()
        elif hasattr(settings, "request"):
            self.settings = settings
        else:
            if not any(hasattr(settings, field.name) for field in fields(SampleRequest)):
                raise SettingsError(complaint(self._where, "settings", "dsrc.SampleRequest", type(settings).__name__))
            warn_deprecated("detector.settings without request", "dsrc.SampleRequest")
            given: dict[str, Any] = {
                field.name: getattr(settings, field.name, field.default) for field in fields(SampleRequest)
            }
            self.settings = SampleRequest(**given)

    def detect(self, sample: Sample) -> Detections:
        """Detect in one sample, best first.

        Raises:
            RuntimeError: the detector asks for the end of the process.
            TypeError: the detector returns something else than `Detections`.
            DataError: a number of these is not finite or out of its range.
        """
        try:
            return checked(self._detector.detect(sample), self._where)
        except SystemExit as error:  # or the command would end with its code, as if all were done
            raise RuntimeError(f"{self._where}.detect: {raised_text(error)}") from None


@cache
def _shipped_request() -> SampleRequest:
    from dsrc.models.storage.checkpoint import load_detector  # torch takes seconds to import

    return load_detector(SHIPPED_DETECTOR).settings.request


def load_own(text: str, what: str, methods: str, *wanted: str) -> Any:
    """Return an instance of `module:Class`, or what a function or a name of a module is.

    Args:
        text: modules of the current folder are found.
        what: perception or detector, for messages.
        methods: that it must have, for messages.
        wanted: names of methods, sets of them joined by `+`; one set must be there.

    Raises:
        SettingsError: the module or the class does not load or was changed since, has none of the sets of methods, or
            names classes that are unknown.
    """
    module, _, name = text.partition(":")
    source, known = source_hash(text), sys.modules.get(module)
    if known is not None and module in _IMPORTED:
        spec, before = _IMPORTED[module]
        if known.__spec__ is not None and known.__spec__ is spec and source != before:
            expected = "the module as it was imported, or a new process"
            raise SettingsError(complaint(what, text, expected, "another, which was changed since"))
    try:
        found = getattr(import_module(module), name)
        spec = sys.modules[module].__spec__
        if module not in _IMPORTED or _IMPORTED[module][0] is not spec:
            _IMPORTED[module] = spec, source
        made = found() if inspect.isclass(found) or inspect.isfunction(found) else found
    except Exception as error:  # code of one's own can fail in any way
        cause = f"{type(error).__name__}: {' '.join(str(error).split())}"
        raise SettingsError(complaint(what, text, "a class that loads", cause)) from None
    classes = getattr(made, "classes", VEHICLES)
    if not isinstance(classes, tuple) or not set(classes) <= set(CLASSES):
        expected = f"a tuple of {', '.join(CLASSES)}"
        raise SettingsError(complaint(what, f"{text}.classes", expected, classes))
    if not any(all(hasattr(made, method) for method in one.split("+")) for one in wanted):
        shown = f"a {type(made).__name__} without them"
        raise SettingsError(complaint(what, text, f"a class with {methods}", shown))
    return made


def source_of(text: str) -> Path | None:
    """Return the source of the module of `module:Class`, None where there is none."""
    module, colon, _ = text.partition(":")
    if not colon:
        return None
    _find_modules_here()
    try:
        found = find_spec(module)
    except Exception:  # packages around it are imported, code of one's own
        return None
    return Path(found.origin) if found is not None and found.has_location and found.origin else None


def source_hash(text: str) -> str:
    """Return the SHA-256 of the source of `module:Class`: of all modules of its package, or of its file.

    Without a source it is of this class in this process, so that no result of another one is served for it.
    """
    path, (module, _, name) = source_of(text), text.partition(":")
    if path is None:
        return f"{_NO_SOURCE}-{id(getattr(sys.modules.get(module), name, None))}"
    package = find_spec(module.partition(".")[0])
    return sources_hash((package and package.submodule_search_locations) or (), path)


def class_hash(text: str) -> str:
    """Return the SHA-256 of the name and the source of `module:Class`."""
    return hashlib.sha256(f"{text} {source_hash(text)}".encode()).hexdigest()


def _find_modules_here() -> None:
    if os.getcwd() not in sys.path and "" not in sys.path:
        sys.path.insert(0, os.getcwd())  # a console script's path begins with its own folder
