"""Traffic backend of a scenario: script, highway-env or SUMO."""

from sim.scenario import Scenario
from sim.traffic.base import DrivableTraffic


def open_traffic(scenario: Scenario, seed: int) -> DrivableTraffic:
    """Start the traffic of a scenario: the script of an encounter, highway-env on its roads, else SUMO.

    Args:
        seed: root seed; equal seeds give equal actors in every process.

    Raises:
        ScenarioError: network, demand or encounter is invalid.
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
