"""Surface materials: reflectivity at 905 nm and display colour."""

from dataclasses import dataclass
from typing import Literal

Finish = Literal["diffuse", "beads", "retro", "glass", "lacquer", "flakes"]
"""Reflection models: rough surface, paint with glass beads, retro-reflector (back to the source at any angle), mirror
(back at normal incidence only), lacquer (smooth, below a clear coat), and lacquer with metal flakes (bright squarely,
dark aslant)."""


@dataclass(frozen=True, slots=True)
class Material:
    """Material of a surface.

    Attributes:
        name: unique key.
        reflectivity: diffuse reflectivity at 905 nm and normal incidence, in [0, 1]; of flakes what is left far off
            their lobe.
        finish: reflection model.
        wets: holds a film of water and darkens; metal, glass, lacquer and plates shed it.
        rgb: colour for pictures, each in [0, 255].
    """

    name: str
    reflectivity: float
    finish: Finish
    wets: bool
    rgb: tuple[int, int, int]


MATERIALS: tuple[Material, ...] = (
    Material("asphalt", 0.15, "diffuse", True, (74, 76, 80)),
    Material("marking", 0.55, "beads", True, (236, 236, 232)),
    Material("pavement", 0.30, "diffuse", True, (158, 156, 150)),
    Material("kerb", 0.38, "diffuse", True, (182, 180, 174)),
    Material("gravel", 0.25, "diffuse", True, (128, 120, 110)),
    Material("ground", 0.45, "diffuse", True, (116, 140, 84)),
    Material("hedge", 0.50, "diffuse", True, (70, 108, 58)),
    Material("leaves", 0.50, "diffuse", True, (84, 128, 62)),
    Material("bark", 0.30, "diffuse", True, (98, 78, 60)),
    Material("brick", 0.35, "diffuse", True, (164, 96, 76)),
    Material("plaster", 0.55, "diffuse", True, (214, 204, 184)),
    Material("concrete", 0.40, "diffuse", True, (170, 168, 162)),
    Material("roof", 0.25, "diffuse", True, (140, 84, 66)),
    Material("glass", 0.0, "glass", False, (110, 150, 172)),
    Material("metal", 0.45, "diffuse", False, (150, 154, 158)),
    Material("dark_metal", 0.20, "diffuse", False, (66, 68, 72)),
    Material("signal_lamp", 0.30, "diffuse", False, (30, 32, 34)),
    Material("sign", 0.85, "retro", False, (36, 84, 168)),
    Material("plate", 0.80, "retro", False, (238, 238, 232)),
    Material("head_lamp", 0.50, "diffuse", False, (246, 240, 206)),
    Material("tail_lamp", 0.60, "retro", False, (190, 28, 30)),
    Material("indicator", 0.45, "diffuse", False, (232, 138, 32)),
    Material("tyre", 0.05, "diffuse", False, (28, 28, 30)),
    Material("paint_white", 0.75, "diffuse", False, (236, 238, 240)),
    Material("paint_silver", 0.50, "diffuse", False, (176, 180, 186)),
    Material("paint_red", 0.60, "diffuse", False, (178, 34, 38)),
    Material("paint_blue", 0.35, "diffuse", False, (42, 80, 150)),
    Material("paint_yellow", 0.65, "diffuse", False, (236, 190, 50)),
    Material("paint_black", 0.06, "diffuse", False, (34, 36, 40)),
    Material("plastic", 0.12, "diffuse", False, (48, 50, 54)),
    Material("skin", 0.55, "diffuse", True, (214, 168, 138)),
    Material("hair", 0.25, "diffuse", True, (72, 54, 42)),
    Material("cloth_light", 0.55, "diffuse", True, (196, 186, 166)),
    Material("cloth_dark", 0.25, "diffuse", True, (50, 58, 84)),
    # Road users of worlds of version 2. Carbon black takes up near infrared as it does light, a few per cent are left;
    # organic pigments (blue, red, brown) let it through to the primer below (Lim et al. 2022, doi
    # 10.1007/s13233-022-0037-5: dark tones of more than 60 % at 905 nm without carbon black). The lobe of flakes is in
    # `sensors.optics.reflectance`.
    Material("solid_black", 0.03, "lacquer", False, (22, 23, 25)),
    Material("solid_dark_blue", 0.10, "lacquer", False, (30, 44, 84)),
    Material("solid_grey", 0.12, "lacquer", False, (112, 116, 118)),
    Material("solid_green", 0.22, "lacquer", False, (58, 92, 66)),
    Material("solid_blue", 0.35, "lacquer", False, (48, 92, 168)),
    Material("solid_red", 0.55, "lacquer", False, (184, 32, 34)),
    Material("solid_dull_white", 0.50, "lacquer", False, (218, 218, 212)),
    Material("solid_yellow", 0.60, "lacquer", False, (232, 182, 40)),
    Material("solid_white", 0.68, "lacquer", False, (242, 243, 244)),
    Material("flakes_black", 0.012, "flakes", False, (34, 36, 40)),
    Material("flakes_dark_grey", 0.020, "flakes", False, (70, 74, 80)),
    Material("flakes_dark_blue", 0.025, "flakes", False, (36, 50, 88)),
    Material("flakes_grey", 0.045, "flakes", False, (122, 127, 132)),
    Material("flakes_brown", 0.05, "flakes", False, (112, 92, 76)),
    Material("flakes_blue", 0.06, "flakes", False, (64, 104, 160)),
    Material("flakes_red", 0.07, "flakes", False, (150, 38, 44)),
    Material("flakes_silver", 0.095, "flakes", False, (190, 194, 199)),
    # What is seen through a pane: the light has crossed it twice, tinted glass passes about half of it each time.
    Material("cabin", 0.03, "diffuse", False, (46, 47, 50)),
    Material("seat", 0.08, "diffuse", False, (78, 76, 74)),
    Material("tarpaulin", 0.50, "diffuse", False, (170, 172, 168)),
    Material("tarpaulin_blue", 0.35, "diffuse", False, (38, 72, 140)),
    Material("wood", 0.50, "diffuse", True, (172, 138, 96)),
    Material("cloth_black", 0.12, "diffuse", True, (34, 34, 38)),
    Material("cloth_denim", 0.40, "diffuse", True, (70, 88, 122)),
    Material("cloth_red", 0.60, "diffuse", True, (170, 50, 52)),
    Material("cloth_white", 0.75, "diffuse", True, (232, 230, 224)),
)
"""Materials by index, which every face carries. New ones are appended: point cloud files hold the index."""

_INDEX = {material.name: index for index, material in enumerate(MATERIALS)}


def material_index(name: str) -> int:
    """Return the index of a material in `MATERIALS`; KeyError for an unknown name."""
    return _INDEX[name]
