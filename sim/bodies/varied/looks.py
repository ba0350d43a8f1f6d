"""Looks of road users in worlds of version 2: shares of paints, liveries and clothes, by material."""

from collections.abc import Mapping

import numpy as np

_PAINTS = {
    "solid_white": 0.10, "solid_dull_white": 0.05, "solid_black": 0.10, "solid_grey": 0.07, "solid_red": 0.05,
    "solid_blue": 0.03, "solid_dark_blue": 0.03, "solid_green": 0.015, "solid_yellow": 0.015, "flakes_black": 0.13,
    "flakes_dark_grey": 0.13, "flakes_grey": 0.08, "flakes_silver": 0.09, "flakes_dark_blue": 0.04, "flakes_blue": 0.03,
    "flakes_red": 0.02, "flakes_brown": 0.02,
}  # fmt: skip
_FLEET = {
    "solid_white": 0.45, "solid_dull_white": 0.12, "flakes_silver": 0.08, "flakes_dark_grey": 0.08,
    "solid_yellow": 0.07, "solid_red": 0.06, "solid_blue": 0.06, "solid_dark_blue": 0.04, "solid_black": 0.04,
}  # fmt: skip
_LIVERIES = {
    "solid_white": 0.30, "solid_yellow": 0.25, "solid_red": 0.20, "solid_blue": 0.12, "solid_green": 0.07,
    "flakes_silver": 0.06,
}  # fmt: skip
_TOPS = {
    "cloth_black": 0.30, "cloth_dark": 0.22, "cloth_denim": 0.12, "cloth_light": 0.14, "cloth_red": 0.12,
    "cloth_white": 0.10,
}  # fmt: skip
_TROUSERS = {"cloth_black": 0.34, "cloth_denim": 0.34, "cloth_dark": 0.20, "cloth_light": 0.12}

LOOKS: dict[str, tuple[Mapping[str, float], ...]] = {
    "paint": (_PAINTS,),
    "fleet": (_FLEET,),
    "livery": (_LIVERIES,),
    "rider": (_PAINTS, _TOPS),
    "clothes": (_TOPS, _TROUSERS),
}
"""Shares of materials by kind of look, one table for each part of it.

Cars: by colour as in the stock and the sales of the last decade (Kraftfahrt-Bundesamt; Axalta, Global Automotive Color
Popularity Reports: grey and silver about 30 %, black 25 %, white 17 %, blue 12 %, red 7 %), most of the dark and grey
ones with metal flakes. Seen at random angles half of the paints return less than a tenth of what white would.
"""


def draw_look(kind: str, rng: np.random.Generator) -> str:
    """Return the materials of a look, joined by +."""
    return "+".join(draw(shares, rng) for shares in LOOKS[kind])


def is_look(kind: str, text: str) -> bool:
    """Return whether a text names materials of a kind of look."""
    parts = text.split("+")
    return len(parts) == len(LOOKS[kind]) and all(p in shares for p, shares in zip(parts, LOOKS[kind], strict=True))


def draw(shares: Mapping[str, float], rng: np.random.Generator) -> str:
    """Return one of the names, drawn by their shares."""
    weights = np.array(list(shares.values()))
    return list(shares)[int(rng.choice(len(weights), p=weights / weights.sum()))]
