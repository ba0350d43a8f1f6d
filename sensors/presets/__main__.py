"""Print docs/lidar_presets.md: `python -m sensors.presets > docs/lidar_presets.md`."""

import sys
from collections.abc import Sequence

import numpy as np

from sensors.optics.beams import beams_of
from sensors.presets import LIDARS
from sensors.spec import LidarSpec

_HEAD = """# LiDAR presets

Printed by `python -m sensors.presets > docs/lidar_presets.md` from `sensors/presets/`; the angles, firing times and
ranges of single beams are in `sensors/presets/tables/`. Points per second are fired beams. Range is the nearest, that
at which a target of reflectivity 0.1 is just detected, and the farthest. Noise is one standard deviation of the range,
and of the angle if the sensor has angle noise. Divergence is the full width at 1/e^2, horizontal x vertical.
"""

_FIGURES = (
    *("preset", "beams", "columns", "Hz", "points/s", "field of view, deg", "range, m", "noise"),
    "divergence, mrad",
)


def document() -> str:
    """Return docs/lidar_presets.md."""
    specs = list(LIDARS.values())
    sources = [(spec.name, spec.source, ", ".join(spec.assumed) or "nothing") for spec in specs]
    return "\n".join(
        [
            _HEAD,
            *_table(_FIGURES, [_figures(spec) for spec in specs]),
            "\n## Sources\n",
            "Fields that no document gave are named as assumed.\n",
            *_table(("preset", "source", "assumed"), sources),
            "",
        ]
    )


def _table(head: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> list[str]:
    return ["| " + " | ".join(row) + " |" for row in (head, ("---",) * len(head), *rows)]


def _figures(spec: LidarSpec) -> tuple[str, ...]:
    vertical = spec.divergence_rad if spec.divergence_vertical_rad is None else spec.divergence_vertical_rad
    angle = f", {spec.angle_noise_deg:g} deg" if spec.angle_noise_deg else ""
    detected = f"{spec.range_10_m:g}" if spec.range_10_m <= spec.range_max_m else "-"
    return (
        spec.name,
        f"{spec.rings}",
        f"{spec.columns}",
        f"{spec.rate_hz:g}",
        f"{spec.rings * spec.columns * spec.rate_hz:,.0f}",
        _field_of_view(spec),
        f"{spec.range_min_m:g}, {detected}, {spec.range_max_m:g}",
        f"{100.0 * spec.range_noise_m:g} cm{angle}",
        f"{1e3 * spec.divergence_rad:.2g} x {1e3 * vertical:.2g}",
    )


def _field_of_view(spec: LidarSpec) -> str:
    if not spec.prisms:
        width = spec.azimuth_end_deg - spec.azimuth_start_deg
        return f"{width:g} x {spec.elevation_deg[0]:+.4g} to {spec.elevation_deg[-1]:+.4g}"
    axes = np.concatenate([beams_of(spec, sweep / spec.rate_hz).axis for sweep in range(20)], axis=2)
    azimuth, elevation = np.degrees(np.arctan2(axes[1], axes[0])), np.degrees(np.arcsin(axes[2]))
    return f"{np.ptp(azimuth):.1f} x {np.ptp(elevation):.1f}, a rosette"


if __name__ == "__main__":
    sys.stdout.write(document())
