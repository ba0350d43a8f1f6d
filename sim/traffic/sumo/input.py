"""SUMO input: options and signal programs."""

from sim.errors import ScenarioError, complaint, did_you_mean
from sim.roads.network import Network
from sim.scenario import Scenario, SignalProgram


def sumo_options(scenario: Scenario, seed: int) -> list[str]:
    """Return the options of every run: sublane model, no teleports, no collision rule of SUMO's own."""
    options = {
        "step-length": scenario.step_s,
        "lateral-resolution": 0.8,
        "time-to-teleport": -1,
        "collision.action": "none",
        "max-num-vehicles": scenario.demand.max_vehicles,
        "max-depart-delay": 30,
        "route-steps": 0,  # all routes are read at once, so that their file can go
        "seed": seed % 2**31,
        "ignore-route-errors": "true",
        "no-warnings": "true",
        "no-step-log": "true",
        "duration-log.disable": "true",
    }
    return [f"--{name}={value}" for name, value in options.items()]


def check_signals(scenario: Scenario, net: Network) -> None:
    """Check signal programs against the network: SUMO's own messages are vague or missing.

    Raises:
        ScenarioError: the junction of a program has no signals, two programs, or another number of signals.
    """
    signals = {
        light.getID(): 1 + max(link for _, _, link in light.getConnections()) for light in net.getTrafficLights()
    }
    seen: set[str] = set()
    for index, program in enumerate(scenario.network.signals):
        field = f"network.signals[{index}]"
        if program.junction not in signals:
            hint = did_you_mean(program.junction, signals)
            raise ScenarioError(
                complaint(scenario.name, f"{field}.junction", "a traffic light of the network", program.junction, hint)
            )
        if program.junction in seen:
            raise ScenarioError(complaint(scenario.name, f"{field}.junction", "one program each", program.junction))
        seen.add(program.junction)
        found = len(program.phases[0][1])
        if found != signals[program.junction]:
            expected = f"states of {signals[program.junction]} letters, one per signal"
            raise ScenarioError(complaint(scenario.name, f"{field}.phases", expected, f"{found} letters"))


def signals_xml(programs: tuple[SignalProgram, ...]) -> str:
    """Return SUMO's additional file with the signal programs of a scenario."""
    lines = ["<additional>"]
    for program in programs:
        lines.append(
            f'<tlLogic id="{program.junction}" type="static" programID="scenario" offset="{program.offset_s:g}">'
        )
        lines += [f'<phase duration="{seconds:g}" state="{state}"/>' for seconds, state in program.phases]
        lines.append("</tlLogic>")
    return "\n".join([*lines, "</additional>\n"])
