"""Lines of sight from the LiDARs of a perception to a road user, by casting their sweeps without any corruption."""

from collections.abc import Collection

import numpy as np

from dsrc.closed_loop.kept import world_scene
from dsrc.closed_loop.log import EpisodeLog
from sensors.recording.encounter_check import UNSEEN_POINTS
from sensors.recording.mounting import mount
from sensors.recording.rig import Rig
from sensors.scan.line_of_sight import seen_share
from sim.traffic.base import Actors


class Eyes:
    """LiDARs of the ego and its helpers over an episode, those of `dsrc.closed_loop.perception.senses`.

    Args:
        cooperative: False leaves the ego alone.

    Raises:
        ScenarioError: the world of the episode cannot be built.
    """

    def __init__(self, log: EpisodeLog, cooperative: bool) -> None:
        settings = log.settings
        self._ego_id = settings.ego_id
        self._scene = world_scene(settings.scenario, settings.seed)
        self._rig = Rig(settings.scenario, self._scene, settings.seed, visibility=False)
        first = log.actors[0]
        self._carriers = self._rig.carriers(first, settings.ego_id) if cooperative else (settings.ego_id,)
        self._roadside = self._rig.roadside if cooperative else {}

    def see(self, now: Actors, object_id: int, helpers: Collection[int] | None = None) -> bool:
        """Return whether a LiDAR has as many points on a road user as an encounter's proof denies the ego.

        A sweep is cast where ten lines to the road user, past the boxes of others, are not all blocked.

        Args:
            helpers: those whose LiDARs count beside the ego's; None for all.
        """
        counting = {*self._carriers, *self._roadside} if helpers is None else {self._ego_id, *helpers}
        present = [one for one in self._carriers if one in now.boxes.object_id and one != object_id and one in counting]
        roadside = {one: unit for one, unit in self._roadside.items() if one in counting}
        bodies, spec = now.world_from_body(), self._rig.vehicle_spec
        lidars = [bodies[k] @ mount(spec, now.boxes.size[k, 2], self._rig.mount) for k in map(now.row, present)]
        lidars += [unit.world_from_lidar for unit in roadside.values()]
        places = np.array([pose[:3, 3] for pose in lidars]).reshape(-1, 3)
        agents, row = [*present, *roadside], np.array([now.row(object_id)])
        share = seen_share(self._scene, now.boxes, places, agents, row)
        looking = [agent for agent, found in zip(agents, share[:, 0], strict=True) if found > 0.0]
        if not looking:
            return False
        frame = self._rig.frame(1, looking, now)
        on_it = frame.points_on[:, frame.truth.object_id == object_id]
        return bool((on_it >= UNSEEN_POINTS).any())
