"""What stands beside the roads of world 2, seen by a car's LiDAR, is within the range of real sweeps.

The ranges are those of twelve sweeps of KITTI (Geiger et al. 2012), Argoverse 2 (Wilson et al. 2021), nuScenes (Caesar
et al. 2020) and SUSTech.
"""

import msgspec
import numpy as np
import pytest
import shapely
from numpy.typing import NDArray

from dsrc.realism.figures import figures_of
from sensors.presets import get_lidar
from sensors.scan.lidar import scan
from sensors.scan.scene import RayScene
from sim.boxes import Boxes
from sim.geometry import pose_matrix
from sim.world.build import build_world
from sim.world.ground import streets_of
from sim.world.roads.streets import Streets
from tests.sim.roads.places import at_hand

REAL = {"standing_5": (0.23, 0.77), "standing_15": (0.39, 0.88), "scattered": (0.19, 0.86)}


def _poses(streets: Streets, count: int) -> list[NDArray[np.float64]]:
    """Return poses of a roof's sensor in the middle of streets of the area."""
    frame = shapely.box(*streets.area)
    found = []
    for lane in streets.lanes:
        line = shapely.LineString(lane.line) & frame
        if lane.kind != "road" or lane.internal or lane.index > 0 or lane.speed < 8.0 or line.length < 25.0:
            continue
        if line.geom_type == "LineString":
            here = shapely.get_coordinates(line.interpolate(0.5, normalized=True))
            way = lane.line[-1] - lane.line[0]
            at = np.array([*here[0], float(streets.height(here)[0]) + 1.9])
            found.append(pose_matrix(at, float(np.arctan2(way[1], way[0]))))
    return found[:: max(1, len(found) // count)][:count]


@pytest.mark.slow
@pytest.mark.parametrize("place", ["four_way"])
def test_shares_of_what_stands_and_is_scattered_are_real(place: str) -> None:
    scenario = msgspec.structs.replace(at_hand(place), world=2)
    scene, streets = RayScene(build_world(scenario, 1)), streets_of(scenario, 1)
    spec, nobody = get_lidar("vlp-32c"), Boxes.from_array(np.zeros((0, 7)), [], [])
    samples = []
    for pose in _poses(streets, 5):
        sweep = scan(scene, spec, pose, pose, 0.0, np.random.default_rng(0))
        samples.append(figures_of(sweep, nobody))
    assert len(samples) >= 4
    for name, (low, high) in REAL.items():
        assert low < float(np.median([one[name] for one in samples])) < high, name
