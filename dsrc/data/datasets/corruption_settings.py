"""Settings of a run of `dsrc corrupt`: those of a severity or of a preset, with values changed by name."""

from collections.abc import Sequence
from typing import Any

import msgspec

from dsrc.options.drives import CorruptOptions
from sensors.corruptions import CORRUPTIONS, Family, preset_settings
from sim.errors import SettingsError, complaint, did_you_mean, one_line


def run_settings(options: CorruptOptions) -> tuple[Family, Any]:
    """Return family and settings of the corruption of a run.

    Raises:
        SettingsError: an unknown preset, or a wrong change of a setting.
    """
    if options.preset is not None:
        family, settings = preset_settings(options.corruption, options.preset)
    else:
        family = options.family
        settings = CORRUPTIONS[options.corruption].settings_of(family).severity(options.severity)
    return family, changed_settings(settings, options.set)


def changed_settings(settings: Any, changes: Sequence[str]) -> Any:
    """Return settings of a corruption with values changed by `field=value`.

    Raises:
        SettingsError: an unknown field, or a value of another type or out of its range.
    """
    known = getattr(settings, "__struct_fields__", ())
    plain = {name: getattr(settings, name) for name in known}
    for change in changes:
        name, _, value = change.partition("=")
        if name not in known:
            found, hint = one_line(name, 80), did_you_mean(name[:80], known)
            raise SettingsError(complaint("corrupt", "set", f"one of {', '.join(known)}", found, hint))
        try:
            plain[name] = msgspec.json.decode(value)
        except (msgspec.DecodeError, RecursionError):
            plain[name] = value
    try:
        return msgspec.convert(plain, type(settings)) if changes else settings
    except msgspec.ValidationError as error:
        raise SettingsError(f"corrupt: set: {error}") from None
