"""A world in its file: half a millimetre from where it was, and the same again afterwards."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sim.bodies.choice import body_mesh, models_for
from sim.catalog.load import load_scenario
from sim.errors import DataError, SettingsError
from sim.world.build import build_world
from sim.world.world_file import load_world, save_world, shapes_of


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[trimesh.Trimesh, Path]:
    world, models = build_world(load_scenario("four_way"), 1), models_for("car") + models_for("bus")
    return world, save_world(world, shapes_of(models), tmp_path_factory.mktemp("world") / "world.npz")


def test_a_world_comes_back_to_the_millimetre_with_its_materials(files: tuple[trimesh.Trimesh, Path]) -> None:
    world, path = files
    again = load_world(path).static
    assert np.abs(again.vertices - world.vertices).max() <= 0.5e-3 + 1e-9
    assert np.array_equal(again.faces, world.faces)
    assert np.array_equal(again.face_attributes["material"], world.face_attributes["material"])
    assert path.stat().st_size < 8 * len(world.faces)


def test_the_bodies_of_sumo_are_kept_and_painted_as_their_models_say(files: tuple[trimesh.Trimesh, Path]) -> None:
    kept = load_world(files[1])
    assert list(kept.shapes) == ["car-normal-citrus"]
    for model in models_for("car"):
        ours, theirs = kept.body_mesh(model, (4.2, 1.8, 1.5)), body_mesh(model, (4.2, 1.8, 1.5))
        assert np.abs(ours.vertices - theirs.vertices).max() < 1e-4
        assert np.array_equal(ours.face_attributes["material"], theirs.face_attributes["material"])
        assert ours.extents == pytest.approx((4.2, 1.8, 1.5))
    for unknown in ("car-normal-citrus:green", "car-normal-citrus"):
        with pytest.raises(SettingsError, match=f"unknown model '{unknown}'"):
            kept.body_mesh(unknown, (4.2, 1.8, 1.5))
    assert np.array_equal(kept.body_mesh("bus:red", (12, 2.5, 3)).vertices, body_mesh("bus:red", (12, 2.5, 3)).vertices)


def test_a_world_written_again_is_the_same_bytes(files: tuple[trimesh.Trimesh, Path], tmp_path: Path) -> None:
    kept = load_world(files[1])
    again = save_world(kept.static, kept.shapes, tmp_path / "again.npz")
    assert again.read_bytes() == files[1].read_bytes()
    assert [path.name for path in tmp_path.iterdir()] == ["again.npz"]


def test_a_damaged_world_is_told_in_one_line(files: tuple[trimesh.Trimesh, Path], tmp_path: Path) -> None:
    good = dict(np.load(files[1]))
    wrong = {
        "version": {"version": np.array(9)},
        "material": {"static/materials": np.array(["cheese"] * len(good["static/materials"]))},
        "few": {"static/material": good["static/material"][:-1]},
        "corner": {"static/corner": good["static/corner"] ^ 129},
        "axes": {"static/x": good["static/x"].ravel()},
        "height": {"static/z": good["static/z"][:, :-1]},
        "part": {"part": np.array(["car"])},
    }
    for name, change in wrong.items():
        np.savez(tmp_path / f"{name}.npz", **{**good, **change})
    (tmp_path / "text.npz").write_text("no archive")
    for name in (*wrong, "text", "missing"):
        with pytest.raises(DataError, match=name) as caught:
            load_world(tmp_path / f"{name}.npz")
        assert "\n" not in str(caught.value)


def test_reading_a_world_needs_no_sumo(files: tuple[trimesh.Trimesh, Path]) -> None:
    code = (
        "import sys; from pathlib import Path; from sim.world.world_file import load_world\n"
        "load_world(Path(sys.argv[1]))\n"
        "found = {'libsumo', 'sumolib', 'sumo', 'torch'} & set(sys.modules)\n"
        "sys.exit(f'imported {found}' if found else 0)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(files[1])], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
