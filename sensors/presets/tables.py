"""Beam tables of real sensors: CSV files from the makers' documents, as fields of a spec.

One row per beam, the highest first. Columns: `laser`, the number in the maker's
documents; `elevation_deg`; `azimuth_deg`, counter-clockwise whatever the maker counts; `firing_us` since the start of
the column; `near_m`, `far_m`. Lines that start with # name the documents.
"""

import csv
import math
from pathlib import Path
from typing import Any

FOLDER = Path(__file__).parent / "tables"


def beam_table(name: str) -> dict[str, Any]:
    """Return the fields of `LidarSpec` that `tables/<name>.csv` gives."""
    lines = (FOLDER / f"{name}.csv").read_text(encoding="utf-8").splitlines()
    rows = list(csv.DictReader(line for line in lines if not line.startswith("#")))
    beams = {key: [float(row[key]) for row in rows] for key in rows[0]}
    fields: dict[str, Any] = {"elevation_deg": tuple(beams["elevation_deg"])}
    if "azimuth_deg" in beams:
        fields["azimuth_offset_deg"] = tuple(beams["azimuth_deg"])
    if "firing_us" in beams:
        fields["firing_s"] = tuple(round(time * 1e-6, 12) for time in beams["firing_us"])
    if "near_m" in beams:
        fields["beam_range_m"] = tuple(zip(beams["near_m"], beams["far_m"], strict=True))
    return fields


def full_divergence(half_maximum_deg: float) -> float:
    """Return the full width at 1/e^2, rad, of a Gaussian beam from its full width at half of its maximum."""
    return round(math.radians(half_maximum_deg) * math.sqrt(2.0 / math.log(2.0)), 6)
