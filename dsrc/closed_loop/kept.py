"""Worlds that are slow to build, kept in the cache folder for every process and later run."""

import os
import time
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import trimesh

from sensors.scan.scene import RayScene
from sim.files import replacing
from sim.kept.files import kept_file
from sim.mesh.solids import MeshPart, to_mesh
from sim.scenario import Scenario
from sim.world.build import build_world

_BUILT_BY = "sim.world.build"
"""Module whose sources and imports are hashed."""

_SLOW_S = 0.3
"""Time of building from which on a world is kept: reading one takes a tenth of it."""
_MOST_WORLDS = 64
"""Worlds kept on disk; the oldest go. A city takes 5 MB."""
_SCENES = 4
"""Scenes kept in memory."""


def world_scene(scenario: Scenario, seed: int) -> RayScene:
    """Return the scene of a scenario's world without bodies; equal scenarios and seeds share one.

    Args:
        scenario: of the world, with its proven encounter.

    Raises:
        ScenarioError: see `sim.world.build.build_world`.
    """
    return _scene(msgspec.json.encode(scenario), seed)


@lru_cache(maxsize=_SCENES)
def _scene(scenario_json: bytes, seed: int) -> RayScene:
    return RayScene(kept_world(msgspec.json.decode(scenario_json, type=Scenario), seed))


def kept_world(scenario: Scenario, seed: int) -> trimesh.Trimesh:
    """Return the world of a scenario, bit for bit that of `build_world`, from the cache folder where it is kept."""
    path = kept_file("worlds", ".npz", _BUILT_BY, scenario, seed)
    with suppress(OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile), _opened(path) as arrays:
        return to_mesh(MeshPart(arrays["vertices"], arrays["faces"].astype(np.int64), arrays["material"]))
    began = time.perf_counter()
    world = build_world(scenario, seed)
    if time.perf_counter() - began > _SLOW_S:
        with suppress(OSError):
            _keep(world, path)
    return world


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    # numpy leaves a damaged file open that it has opened itself
    with path.open("rb") as file, np.load(file) as arrays:
        yield arrays


def _keep(world: trimesh.Trimesh, path: Path) -> None:
    """Write a world, and remove the oldest ones."""
    material = np.asarray(world.face_attributes["material"], np.uint8)
    with replacing(path) as temporary, temporary.open("wb") as file:
        np.savez(file, vertices=world.vertices, faces=np.asarray(world.faces, np.int32), material=material)
    known = sorted(path.parent.glob("*.npz"), key=os.path.getmtime)
    for old in known[:-_MOST_WORLDS]:
        old.unlink(missing_ok=True)
