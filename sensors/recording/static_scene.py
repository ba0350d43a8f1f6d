"""Scene of a scenario's static world, built once for the proof of an encounter and for all who drive through it."""

from functools import lru_cache

import msgspec

from sensors.scan.scene import RayScene
from sim.scenario import Scenario

_KEPT = 4
"""Scenes kept: a city takes some hundred MB."""


def static_scene(scenario: Scenario, seed: int) -> RayScene:
    """Return the scene of a scenario's world without bodies; equal scenarios and seeds share one.

    Args:
        scenario: of the world.
        seed: of its generated parts.

    Raises:
        ScenarioError: see `sim.world.build.build_world`.
    """
    return _built(msgspec.json.encode(scenario), seed)


@lru_cache(maxsize=_KEPT)
def _built(scenario_json: bytes, seed: int) -> RayScene:
    from sim.world.build import build_world

    return RayScene(build_world(msgspec.json.decode(scenario_json, type=Scenario), seed))
