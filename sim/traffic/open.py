"""Which backend moves the traffic of a scenario."""

from sim.scenario import Scenario
from sim.traffic.base import Traffic


def open_traffic(scenario: Scenario, seed: int) -> Traffic:
    """Start the traffic of a scenario: its script when it is a conflict, highway-env on its roads, else SUMO.

    Args:
        scenario: what to simulate.
        seed: of everything random; equal seeds give equal actors in every process.

    Raises:
        ScenarioError: network, demand or conflict cannot be made.
        TrafficError: the backend cannot run.
    """
    if scenario.conflict is not None:
        from sim.traffic.script import ScriptedTraffic

        return ScriptedTraffic(scenario, seed)
    if scenario.network.highway_env:
        from sim.traffic.highway.traffic import HighwayTraffic

        return HighwayTraffic(scenario, seed)
    from sim.traffic.sumo.traffic import SumoTraffic

    return SumoTraffic(scenario, seed)
