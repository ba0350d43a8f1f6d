"""What SUMO is started with: options and signal programs."""

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


def signals_xml(programs: tuple[SignalProgram, ...]) -> str:
    """Return an additional file with the signal programs of a scenario."""
    lines = ["<additional>"]
    for program in programs:
        lines.append(
            f'<tlLogic id="{program.junction}" type="static" programID="scenario" offset="{program.offset_s:g}">'
        )
        lines += [f'<phase duration="{seconds:g}" state="{state}"/>' for seconds, state in program.phases]
        lines.append("</tlLogic>")
    return "\n".join([*lines, "</additional>\n"])
