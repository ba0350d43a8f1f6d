"""Picture of an environment: highway-env's viewer, with the roads as surfaces and what the ego does not perceive.

The ego is green, red after a crash; its tracks are blue; outlines are road users that it has no track of, which it
cannot know.
"""

import numpy as np
import pygame
from highway_env.envs.common.graphics import EnvViewer, ObservationGraphics
from highway_env.road.graphics import RoadGraphics, WorldSurface
from highway_env.vehicle.graphics import VehicleGraphics
from numpy.typing import NDArray

from dsrc.closed_loop.environments.roads import IndexedRoadNetwork, to_plane
from dsrc.closed_loop.types import Tick
from sim.traffic.base import Actors

EGO, CRASHED, TRACK = (80, 220, 60), (255, 70, 70), (90, 180, 255)
_GROUND, _ROAD, _LINE, _UNSEEN = (205, 208, 200), (92, 95, 100), (235, 235, 235), (200, 30, 30)
_TRACKED_M = 2.5
"""Distance from a track within which a road user counts as perceived, m."""


class LoopViewer(EnvViewer):
    """Viewer of a `DrivingEnv`; its config is highway-env's."""

    def display(self) -> None:
        """Draw the present step."""
        if not self.enabled:
            return
        surface = self.sim_surface
        surface.move_display_window_to(self.window_position())
        network = self.env.road.network
        if isinstance(network, IndexedRoadNetwork):
            draw_roads(network, surface)
        else:
            RoadGraphics.display(self.env.road, surface)
        draw_unseen(self.env.loop.tick, self.env.loop.ego_id, surface)
        for vehicle in reversed(self.env.road.vehicles):
            VehicleGraphics.display(vehicle, surface, offscreen=self.offscreen)
        ObservationGraphics.display(self.env.observation_type, surface)
        if not self.offscreen:
            self.screen.blit(surface, (0, 0))
            if self.env.config["real_time_rendering"]:
                self.clock.tick(self.env.config["policy_frequency"])
            pygame.display.flip()


def draw_roads(network: IndexedRoadNetwork, surface: WorldSurface) -> None:
    """Draw the lanes in the window as surfaces with borders."""
    surface.fill(_GROUND)
    low = np.asarray(surface.origin, np.float64)
    high = low + np.array(surface.get_size()) / surface.scaling
    lanes = network.lanes_within(low, high)
    for lane in lanes:
        pygame.draw.polygon(surface, _ROAD, _pixels(np.concatenate([lane.left, lane.right[::-1]]), surface))
    for lane in lanes:
        if lane.bordered:
            for border in (lane.left, lane.right):
                pygame.draw.lines(surface, _LINE, False, _pixels(border, surface), 1)


def draw_unseen(tick: Tick, ego_id: int, surface: WorldSurface) -> None:
    """Draw outlines of the road users that have no track near them."""
    actors, tracks = tick.actors, tick.tracks.boxes.center[:, :2]
    away = np.linalg.norm(actors.boxes.center[:, None, :2] - tracks[None], axis=2).min(axis=1, initial=np.inf)
    for row in np.flatnonzero((away > _TRACKED_M) & (actors.boxes.object_id != ego_id)):
        if surface.is_visible(to_plane(actors.boxes.center[row, :2])):
            pygame.draw.polygon(surface, _UNSEEN, _pixels(_footprint(actors, int(row)), surface), 2)


def _footprint(actors: Actors, row: int) -> NDArray[np.float64]:
    center, yaw = actors.boxes.center[row, :2], float(actors.boxes.yaw[row])
    half = 0.5 * actors.boxes.size[row, :2] * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    turn = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    return to_plane(center + half @ turn)


def _pixels(points: NDArray[np.float64], surface: WorldSurface) -> list[list[int]]:
    return ((points - surface.origin) * surface.scaling).round().astype(int).tolist()
