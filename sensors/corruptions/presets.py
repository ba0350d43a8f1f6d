"""Published settings by kind and name, those that `--preset` takes.

| source       | levels                 | kinds of ours                                                                |
|--------------|------------------------|------------------------------------------------------------------------------|
| Robo3D       | light, moderate, heavy | all six and incomplete echo, wet ground; by data set where its figures differ|
| MultiCorrupt | 1, 2, 3                | fog, snow, motion blur, beams reducing = `cross_sensor`, points reducing =   |
|              |                        | `point_dropping`                                                             |
| CoopDiff     | one                    | EMI = `cross_sensor`, as DSRC's to the bit; water = `wet_ground`             |

MultiCorrupt's misalignments, in space and in time, are errors between sensors of one car: no cloud changes. Sources:
Beemelmanns et al. (IV 2024); Chen et al., CoopDiff (arXiv 2603.01688); see `sensors.corruptions.published` for others.
"""

from typing import Any

from sensors.corruptions.physics.levels import DEFAULT_SEVERITY
from sensors.corruptions.point_dropping import PointDropping
from sensors.corruptions.published import beams, fog, incomplete_echo, points, rain, snow, wet_ground
from sensors.corruptions.registry import CLEAN, CORRUPTIONS, Family, require_corruption
from sim.errors import SettingsError, complaint, did_you_mean

PRESETS: dict[str, dict[str, Any]] = {
    "beam_missing": beams.PUBLISHED_BEAM_MISSING,
    "cross_sensor": beams.PUBLISHED_CROSS_SENSOR,
    "motion_blur": points.PUBLISHED_MOTION_BLUR,
    "crosstalk": points.PUBLISHED_CROSSTALK,
    "incomplete_echo": incomplete_echo.PUBLISHED,
    "fog": fog.PUBLISHED,
    "snow": snow.PUBLISHED,
    "wet_ground": wet_ground.PUBLISHED,
    "rain": rain.PUBLISHED,
    "point_dropping": {
        f"multicorrupt_{level}": PointDropping(share=share) for level, share in ((1, 0.2), (2, 0.4), (3, 0.6))
    },
}
"""Settings by kind and by source: paper, data set and level."""


def settings_of(
    kind: str, severity: int | None = None, family: Family | None = None, preset: str | None = None
) -> tuple[Family, Any]:
    """Return the family and the settings of a kind, by severity and family or by a preset in their place.

    Args:
        kind: key of `CORRUPTIONS`, or `clean`, which has no settings: None.
        severity: 1 to 5; None for 3, or with a preset.
        family: of the settings; None for the physical one, or with a preset.

    Raises:
        SettingsError: an unknown kind, severity, family or preset, or a preset beside one of the others.
    """
    level, of = DEFAULT_SEVERITY if severity is None else severity, family or "physical"
    require_corruption(kind, level, of)
    if preset is None:
        return of, None if kind == CLEAN else CORRUPTIONS[kind].settings_of(of).severity(level)
    where = f"corruption '{kind}'"
    if severity is not None or family is not None:
        given = "family" if severity is None else "severity"
        raise SettingsError(f"{where}: preset {preset} has a severity and family of its own; leave out the {given}")
    named = PRESETS.get(kind, {})
    if preset not in named:
        hint = did_you_mean(preset, named) or f"; there is none of {kind}"
        raise SettingsError(complaint(where, "preset", "a published setting", preset, hint))
    return "physical" if CORRUPTIONS[kind].paper_settings is None else "paper", named[preset]
