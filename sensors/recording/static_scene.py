"""Static world of a scenario as a scene for rays and as solid parts, built once for all who drive through it."""

from functools import lru_cache

import msgspec

from sensors.scan.scene import RayScene
from sim.contact import SolidWorld
from sim.scenario import Scenario

_KEPT = 4
"""Scenes kept: a city takes some hundred MB."""


def static_scene(scenario: Scenario, seed: int) -> RayScene:
    """Return the scene of a scenario's world without bodies; equal scenarios and seeds share one.

    Raises:
        ScenarioError: see `sim.world.build.build_world`.
    """
    return _built(msgspec.json.encode(scenario), seed)


def solid_world(scenario: Scenario, seed: int) -> SolidWorld:
    """Return the solid parts of a scenario's world; equal scenarios and seeds share one.

    Raises:
        ScenarioError: see `sim.world.build.build_world`.
    """
    return _solid(msgspec.json.encode(scenario), seed)


@lru_cache(maxsize=_KEPT)
def _solid(scenario_json: bytes, seed: int) -> SolidWorld:
    from sim.world.build import build_world

    return SolidWorld.of(build_world(msgspec.json.decode(scenario_json, type=Scenario), seed))


@lru_cache(maxsize=_KEPT)
def _built(scenario_json: bytes, seed: int) -> RayScene:
    from sim.world.build import build_world

    return RayScene(build_world(msgspec.json.decode(scenario_json, type=Scenario), seed))
