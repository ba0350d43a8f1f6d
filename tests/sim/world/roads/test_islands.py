"""Islands of junctions: off every lane and crossing, raised by kerbs, and long vehicles pass beside them."""

import msgspec
import numpy as np
import shapely

from sim.catalog.load import load_scenario
from sim.world.build import build_world
from sim.world.ground import streets_of
from sim.world.roads.kerbs import KERB_M
from sim.world.standing import open_standing


def test_wide_junctions_have_islands_that_no_lane_leads_over_and_no_vehicle_stands_on() -> None:
    scenario = msgspec.structs.replace(load_scenario("ingolstadt"), world=2, warmup_s=20.0)
    streets = streets_of(scenario, 1)
    islands = streets.islands & shapely.box(*streets.area)
    assert len(shapely.get_parts(islands)) >= 5 and islands.area > 100.0
    assert (islands & streets.road).area < 0.01
    lanes = [lane for lane in streets.lanes if lane.kind in ("road", "bicycle", "crossing")]
    ways = [shapely.LineString(lane.line).buffer(0.5 * lane.width, cap_style="flat") for lane in lanes]
    assert (islands & shapely.union_all(ways)).area < 0.5
    assert streets.land is not None
    inner = np.array([part.representative_point().coords[0] for part in shapely.get_parts(islands)])
    rise = streets.height(inner) - streets.terrain.height(inner)
    np.testing.assert_allclose(np.median(rise), KERB_M, atol=0.05)
    # Something stands on most of them, more than a metre high.
    mesh = build_world(scenario, 1)
    corners = np.asarray(mesh.vertices)
    low = corners[:, 2] - streets.terrain.height(corners[:, :2])
    tall = shapely.MultiPoint(corners[(low > 1.0) & (low < 5.0)][:, :2])
    shapely.prepare(tall)
    assert np.mean([shapely.intersects(tall, part) for part in shapely.get_parts(islands)]) > 0.6
    shapely.prepare(islands)
    with open_standing(scenario, 1) as traffic:
        for _ in range(200):
            boxes = traffic.step().boxes
            centres = boxes.center[boxes.is_vehicle, :2]
            assert not shapely.contains_xy(islands, *centres.T).any()


def test_encounters_keep_their_junctions_free_of_islands() -> None:
    scenario = msgspec.structs.replace(load_scenario("braunschweig_lta_truck"), world=2)
    assert streets_of(scenario, 1).islands.is_empty
