"""How much weather adds to a sweep and takes from it, through a simulator's receiver, a real one, and as published.

Usage:
    python -m studies.pictures.weather_shares
    python -m studies.pictures.weather_shares --docs docs/corruptions.md
    python -m studies.pictures.weather_shares --scenario ingolstadt --lidar hdl-64e-s2
"""

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np

from sensors.corruptions import CORRUPTIONS, SEVERITIES, corrupt
from sensors.frame import Frame
from sensors.presets import LIDARS, get_lidar
from sensors.recording.record import record
from sensors.recording.rig import Rig
from sensors.sweep import ADDED, SCATTERED, Sweep
from sim.catalog.load import load_scenario
from sim.traffic.sumo.traffic import SumoTraffic
from sim.world.build import build_world
from studies.look import put_table

KINDS = tuple(kind for kind, corruption in CORRUPTIONS.items() if corruption.weather)
SEED, AFTER_S, INTERVAL_S = 2, 12.0, 0.1


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scenario", default="berlin", help="where the sweep is taken: %(default)s when left out")
    parser.add_argument("--lidar", choices=LIDARS, default="opv2v-64", help="%(default)s when left out")
    parser.add_argument("--docs", type=Path, help="document whose table `weather_shares` is replaced")
    options = parser.parse_args()
    frame = street(options.scenario, options.lidar)
    head = f"scattered / lost, % of {len(frame.agents[0].sweep):,} points"
    put_table(options.docs, "weather_shares", (head, *map(str, SEVERITIES)), list(rows(frame)))


def street(scenario_name: str, lidar: str) -> Frame:
    """Return one frame of a drive some seconds after its start, its first vehicle alone."""
    scenario = load_scenario(scenario_name)
    steps = round(AFTER_S / INTERVAL_S)
    with SumoTraffic(scenario, SEED) as traffic:
        drive = record(traffic, build_world(scenario, SEED), scenario, SEED, steps + 1, INTERVAL_S)
    rig = Rig(scenario, drive.rig.scene, SEED, vehicle_spec=get_lidar(lidar))
    frame = replace(drive, rig=rig).frame(steps)
    vehicle = next(row for row, agent in enumerate(frame.agents) if agent.kind == "vehicle")
    return frame.of_agents([vehicle])


def rows(frame: Frame) -> Iterator[tuple[str, ...]]:
    """Yield the table's lines: each kind of weather by each receiver, at every severity."""
    clean = frame.agents[0].sweep
    spec = clean.spec
    if spec is None:
        raise ValueError("a simulated sweep knows its sensor")
    for kind in KINDS:
        name = kind.replace("_", " ")
        for label, range_10_m in ((f"{name}, R10 = {spec.range_10_m:g} m", spec.range_10_m), (f"**{name}**", None)):
            yield label, *(shares(weathered(frame, kind, s, range_10_m), clean) for s in SEVERITIES)
        if CORRUPTIONS[kind].paper_apply is not None:
            made = (corrupt(clean, kind, s, np.random.default_rng(SEED), "paper") for s in SEVERITIES)
            yield f"{name}, `paper`", *(shares(sweep, clean) for sweep in made)


def weathered(frame: Frame, kind: str, severity: int, range_10_m: float | None) -> Sweep:
    """Return the first agent's sweep in weather.

    Args:
        frame: in clear air.
        kind: of the physical family.
        severity: 1 to 5.
        range_10_m: of the receiver, see `LidarSpec`; None for what the weather takes.
    """
    corruption = CORRUPTIONS[kind]
    settings = msgspec.structs.replace(corruption.settings.severity(severity), range_10_m=range_10_m)
    rng = np.random.default_rng(SEED)
    if corruption.apply is not None:
        return corruption.apply(frame.agents[0].sweep, settings, rng)
    assert corruption.in_frame is not None
    return corruption.in_frame(frame, 0, settings, rng)


def shares(sweep: Sweep, clean: Sweep) -> str:
    """Return the share of the points that the medium sent, and of the surfaces' points that are gone, in percent."""
    scattered = np.mean(sweep.fate == SCATTERED)
    lost = 1.0 - np.count_nonzero(sweep.object_id != ADDED) / len(clean)
    return f"{100.0 * scattered:.1f} / {100.0 * lost:.1f}"


if __name__ == "__main__":
    main()
