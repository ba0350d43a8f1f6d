"""Settings of channels and ranges of numbers, without a network: cheap to import."""

from pathlib import Path
from typing import Any

import msgspec

from sim.errors import SettingsError, complaint
from sim.files import file_sha256
from sim.radio import ChannelSpec


def check_numbers(where: str, seed: int, limit: int | None) -> None:
    """Raise SettingsError for a number out of its range; `where` begins the message."""
    if seed < 0:
        raise SettingsError(complaint(where, "seed", "at least 0", seed))
    if limit is not None and limit < 1:
        raise SettingsError(complaint(where, "limit", "at least 1 frame (--frames)", limit))


def channel_settings(spec: ChannelSpec) -> dict[str, Any]:
    """Settings of a channel without its name; of a trace the hash of its file."""
    settings = msgspec.to_builtins(spec)
    del settings["name"]
    return {**settings, "trace": file_sha256(Path(spec.trace))} if spec.trace else settings
