"""Corruptions: weather and sensor failures on LiDAR sweeps.

Two families of settings, never mixed: `physical`, one module of this package per physical cause, is the default;
`paper`, the modules of `sensors.corruptions.published`, one per published model, computes what was published, to
compare with its tables. Not every kind has a published model. A corruption draws the same numbers at every severity,
wherever possible.
"""

from sensors.corruptions.apply import (
    EVERYONE,
    CorruptedAgents,
    corrupt,
    corrupt_frame,
    corruption_rng,
    drive_seed,
    ego_of,
    parse_agents,
    require_agents,
)
from sensors.corruptions.check import check_corruption
from sensors.corruptions.condition import PAPER_TABLE, Changes, Condition, conditions_of, corruption_kinds
from sensors.corruptions.physics.levels import DEFAULT_SEVERITY, SEVERITIES
from sensors.corruptions.presets import PRESETS, settings_of
from sensors.corruptions.registry import (
    CLEAN,
    CORRUPTIONS,
    FAMILIES,
    PAPER_SIX,
    Corruption,
    Family,
    kinds_of,
    register_corruption,
    require_corruption,
    require_family,
)

__all__ = [
    "CLEAN",
    "CORRUPTIONS",
    "DEFAULT_SEVERITY",
    "EVERYONE",
    "FAMILIES",
    "PAPER_SIX",
    "PAPER_TABLE",
    "PRESETS",
    "SEVERITIES",
    "Changes",
    "Condition",
    "Corruption",
    "Family",
    "CorruptedAgents",
    "check_corruption",
    "conditions_of",
    "corrupt",
    "corrupt_frame",
    "corruption_kinds",
    "corruption_rng",
    "drive_seed",
    "ego_of",
    "kinds_of",
    "parse_agents",
    "register_corruption",
    "require_corruption",
    "require_family",
    "require_agents",
    "settings_of",
]
