"""A toy encounter: a wall between the ego and a car that its helper sees, beside a car before the wall."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from dsrc.closed_loop import kept
from dsrc.data.sample import Sample
from dsrc.ops.detections import Detections
from sim.boxes import Boxes
from sim.geometry import invert
from sim.scenario import Scenario
from sim.traffic.base import Actors
from tests.dsrc.evaluation.fakes import PointCounter
from tests.sensors.fakes import box, box_body, cars, ground, toy_scenario

EGO, HELPER, NEAR, HIDDEN = 1000, 1001, 1002, 1003
NAMES = ("ego", "helper", "near", "hidden")
PLACES = [[0, 0, 0], [30, 14, np.pi], [12, 4, 0], [30, 0, 0]]
LIE = [[30.0, 7.0, 0.0]]
"""Place of a car that the helper claims: between it and the hidden one, behind the wall for the ego."""
SCENARIO = toy_scenario(named=("ego", "helper"), mount_xyz_m=(0.5, 0.0, 2.1))
WORLD_FROM_LIDAR = np.array([[1.0, 0, 0, 0.5], [0, 1.0, 0, 0], [0, 0, 1.0, 2.1], [0, 0, 0, 1.0]])


def build(monkeypatch: pytest.MonkeyPatch) -> None:
    """Put the wall and box bodies in place of a scenario's world."""
    wall = box((1.0, 20.0, 4.0), (18.5, 0.0, 2.0))
    monkeypatch.setattr("sim.bodies.choice.body_mesh", box_body)
    show(monkeypatch, lambda scenario, seed: ground() + wall)


def show(monkeypatch: pytest.MonkeyPatch, world: Callable[[Scenario, int], trimesh.Trimesh]) -> None:
    """Put a world in place of every scenario's, recorded or sensed, and none of them on disk."""
    monkeypatch.setattr("sim.world.build.build_world", world)
    monkeypatch.setattr(kept, "kept_world", world)
    kept._scene.cache_clear()


def instant(step: int, speed: float = 0.0) -> Actors:
    """The four cars, the hidden one driving at `speed`."""
    rows = [*PLACES[:3], [PLACES[3][0] + 0.1 * speed * step, 0.0, 0.0]]
    return replace(cars(rows, speed=[0.0, 0.0, 0.0, speed], time_s=0.1 * step), name=NAMES)


def claim() -> dict[str, Actors]:
    return {"helper": replace(cars(LIE), name=("ghost",))}


class Knowing(PointCounter):
    """Detects cars of given places in the world where it has points above the ground, whatever the sample tells."""

    def __init__(self, places: list[list[float]], need: int = 3) -> None:
        super().__init__(need)
        self.places = places

    def detect(self, sample: Sample) -> Detections:
        known: Boxes = cars(self.places).boxes.transform(sample.ego_from_agent[0] @ invert(WORLD_FROM_LIDAR))
        bodies = tuple(cloud[cloud[:, 2] > 0.3 - WORLD_FROM_LIDAR[2, 3]] for cloud in sample.clouds)
        found = super().detect(replace(sample, boxes=known, clouds=bodies))
        self.seen[-1] = sample
        return found
