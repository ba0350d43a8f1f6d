"""Proofs of encounters and worlds that are slow to build, kept in the cache folder for every process and later run.

A file is named by a hash of all that decides its content: settings, seed, sensors, the files of the roads, code and
versions of other packages. It is there completely or not at all; one that is damaged is made again.
"""

import hashlib
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
from msgspec.structs import replace

from dsrc.data.code_hash import code_hash, package_versions
from sensors.presets import scenario_lidars
from sensors.recording.encounter_check import find_encounter
from sensors.scan.scene import RayScene
from sim.encounters import with_encounter
from sim.files import file_sha256, replacing, write_file
from sim.mesh.solids import MeshPart, to_mesh
from sim.roads.cache import cache_folder
from sim.roads.networks import names_network, resolve_network, resolve_polygons
from sim.scenario import Scenario
from sim.world.build import build_world

_PROVEN_BY = "sensors.recording.encounter_check"
_BUILT_BY = "sim.world.build"
"""Modules whose sources and imports are hashed."""

_SLOW_S = 0.3
"""Time of building from which on a world is kept: reading one takes a tenth of it."""
_MOST_WORLDS = 64
"""Worlds kept on disk; the oldest go. A city takes 5 MB."""
_SCENES = 4
"""Scenes kept in memory."""


def proven_scenario(scenario: Scenario, seed: int) -> Scenario:
    """Return a scenario with the proven draw, agents and area of its encounter; others unchanged.

    As `sensors.recording.encounter_check.with_proven_encounter`, but each draw is proven once. A control takes the draw
    of its encounter.

    Raises:
        ScenarioError: no proof holds, or a value is out of its range.
    """
    if scenario.conflict is None or scenario.agents.named:
        return scenario
    control = scenario.conflict.control
    name = scenario.name.removesuffix(f"-{control}")  # a control's is that of its encounter and its own
    bare = replace(scenario, name=name, conflict=replace(scenario.conflict, control=""))
    draw = _proven_draw(msgspec.json.encode(bare), seed)
    return with_encounter(replace(scenario, conflict=replace(scenario.conflict, draw=draw)), seed)


@lru_cache(maxsize=64)
def _proven_draw(scenario_json: bytes, seed: int) -> int:
    scenario = msgspec.json.decode(scenario_json, type=Scenario)
    sensors = msgspec.json.encode(scenario_lidars(with_encounter(scenario, seed))).decode()
    path = _file("encounters", ".json", [*_decisive(scenario, seed, _PROVEN_BY), sensors])
    with suppress(OSError, msgspec.MsgspecError):
        return msgspec.json.decode(path.read_bytes(), type=int)
    conflict = find_encounter(scenario, seed).scenario.conflict
    assert conflict is not None
    with suppress(OSError):  # a cache that cannot be written to costs time alone
        write_file(path, msgspec.json.encode(conflict.draw))
    return conflict.draw


def world_scene(scenario: Scenario, seed: int) -> RayScene:
    """Return the scene of a scenario's world without bodies; equal scenarios and seeds share one.

    Args:
        scenario: of the world, with its proven encounter.
        seed: of its generated parts.

    Raises:
        ScenarioError: see `sim.world.build.build_world`.
    """
    return _scene(msgspec.json.encode(scenario), seed)


@lru_cache(maxsize=_SCENES)
def _scene(scenario_json: bytes, seed: int) -> RayScene:
    return RayScene(_world(msgspec.json.decode(scenario_json, type=Scenario), seed))


def _world(scenario: Scenario, seed: int) -> trimesh.Trimesh:
    """Return the world of a scenario, bit for bit that of `build_world`."""
    path = _file("worlds", ".npz", _decisive(scenario, seed, _BUILT_BY))
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


def _decisive(scenario: Scenario, seed: int, entry: str) -> list[Any]:
    """Return what decides the result of a module for a scenario and a seed."""
    files = [resolve_network(scenario, seed), resolve_polygons(scenario)] if names_network(scenario) else []
    roads = [file_sha256(path) for path in files if path is not None]
    return [msgspec.json.encode(scenario).decode(), seed, roads, code_hash(entry), package_versions(entry)]


def _file(kind: str, ending: str, key: list[Any]) -> Path:
    digest = hashlib.sha256(msgspec.json.encode(key, order="deterministic")).hexdigest()[:32]
    return cache_folder() / kind / f"{digest}{ending}"
