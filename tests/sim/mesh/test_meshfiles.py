import struct
from pathlib import Path

import numpy as np
import pytest

from sim.errors import ScenarioError
from sim.mesh.meshfiles import read_3ds, read_obj
from sim.roads.tools import sumo_tools


def chunk(kind: int, content: bytes) -> bytes:
    return struct.pack("<HI", kind, len(content) + 6) + content


def small_3ds() -> bytes:
    def mesh(shift: float) -> bytes:
        vertices = struct.pack("<H12f", 4, *np.float32([[0, 0, 0], [1, 0, 0], [0, 1, 0], [shift] * 3]).ravel())
        used = chunk(0x4130, b"wall\0" + struct.pack("<HH", 1, 1))
        faces = struct.pack("<H8H", 2, 0, 1, 2, 0, 0, 2, 3, 0) + used
        return chunk(0x4000, b"thing\0" + chunk(0x4100, chunk(0x4110, vertices) + chunk(0x4120, faces)))

    return chunk(0x4D4D, chunk(0x0002, b"\3\0\0\0") + chunk(0x3D3D, mesh(5.0) + mesh(7.0)))


def test_every_object_of_a_3ds_file_is_read_with_its_materials(tmp_path: Path) -> None:
    path = tmp_path / "small.3ds"
    path.write_bytes(small_3ds())
    mesh = read_3ds(path)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]]
    assert mesh.group.tolist() == ["", "wall", "", "wall"]
    assert mesh.vertices[[3, 7], 0].tolist() == [5.0, 7.0]


@pytest.mark.parametrize("keep", [0, 1, 3, 40, 100, 150])
def test_a_truncated_3ds_file_is_one_line(tmp_path: Path, keep: int) -> None:
    path = tmp_path / "cut.3ds"
    path.write_bytes(small_3ds()[:keep])
    with pytest.raises(ScenarioError, match=r"cut\.3ds") as caught:
        read_3ds(path)
    assert "\n" not in str(caught.value)


def test_the_city_mesh_of_sumo_has_the_known_number_of_triangles() -> None:
    mesh = read_3ds(sumo_tools() / "game" / "bs3d" / "bs3.3ds")
    assert len(mesh.faces) == 53893 and len(set(mesh.group) - {""}) == 21


def test_polygons_of_an_obj_file_become_fans(tmp_path: Path) -> None:
    path = tmp_path / "quad.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nusemtl roof\nf 1//1 2//1 3//1 4//1\nf -4 -3 -2\n")
    mesh = read_obj(path)
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]] and set(mesh.group) == {"roof"}


@pytest.mark.parametrize("text", ["", "v 0 0 0\n", "v 0 0 x\nf 1 1 1\n", "v 0 0 0\nf 1 2 3\n"])
def test_a_broken_obj_file_is_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "broken.obj"
    path.write_text(text)
    with pytest.raises(ScenarioError, match=r"broken\.obj"):
        read_obj(path)
