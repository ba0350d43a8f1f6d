"""The same crash with and without cooperation: both drives of one encounter from above, and their speeds.

Usage:
    python -m studies.closed_loop.same_crash --out docs/pictures/closed_loop
    python -m studies.closed_loop.same_crash --out pictures --scenario ima_queue --seed 4 --perceptions sight truth
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Polygon
from shapely import LineString

import dsrc
from sim.encounters import network_file
from sim.roads.networks import read_network
from studies.look import COLORS, FAINT, HIGHLIGHT, PAGE, new_figure, save, style

NAMES = {
    "truth": "the truth",
    "sight": "the truth in its sight",
    "ego": "its own LiDAR",
    "team": "its own and its helpers' LiDARs",
}
EGO, CONFLICT, OTHER, ROAD = COLORS[0], COLORS[3], "#6B7685", "#242B35"
CONFLICT_ID = 1001  # of every encounter
REACH_M = (30.0, 19.0)
BEFORE_S = 1.5
"""Time before the contact at which the tracks are drawn, s."""


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder of the picture")
    parser.add_argument("--scenario", default="lta_truck")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--perceptions", nargs=2, default=("ego", "team"), metavar="NAME")
    options = parser.parse_args()
    logs = [drive(options.scenario, name, options.seed) for name in options.perceptions]
    print(draw(logs, options.out / f"{options.scenario}_{'_'.join(options.perceptions)}.png"))


def drive(scenario: str, perception: str, seed: int) -> dsrc.EpisodeLog:
    """Return the log of one drive, five percepts a second."""
    settings = dsrc.LoopSettings(duration_s=12.0, detect_every_s=0.2)
    loop = dsrc.ClosedLoop(
        scenario, dsrc.open_perception(perception, interval_s=0.2, engine="fused"), settings=settings
    )
    loop.run(seed)
    return loop.log(perception=perception)


def draw(logs: list[dsrc.EpisodeLog], path: Path) -> Path:
    """Draw both drives at the instant of the first contact of either, and the speeds of their egos."""
    settings = logs[0].settings
    moment_s = min((log.contact.time_s for log in logs if log.contact), default=logs[0].ticks[-1].ego.time_s)
    with style():
        note = f"{settings.scenario.name}, seed {settings.seed}. Filled: {BEFORE_S:g} s before the contact, with the "
        note += "tracks of the ego (orange). Outlined: ego (blue) and conflict actor (red) at the contact."
        figure = new_figure(9.6, 5.9, "One encounter, the same driver, other eyes", note)
        grid = figure.add_gridspec(2, 2, height_ratios=[2.1, 1.0])
        middle = center(logs[0], moment_s)
        for column, log in enumerate(logs):
            axes = figure.add_subplot(grid[0, column])
            from_above(axes, log, moment_s, middle)
            axes.set_title(f"eyes: {NAMES[log.settings.perception]}: {log.outcome.value}")
            speeds(figure.add_subplot(grid[1, column]), log, moment_s)
        return save(figure, path, colors=96, keep=[EGO, CONFLICT, HIGHLIGHT])


def start_s(log: dsrc.EpisodeLog) -> float:
    return log.ticks[0].ego.time_s


def center(log: dsrc.EpisodeLog, moment_s: float) -> np.ndarray:
    """Return where the picture of a drive is centred: between ego and conflict actor, m."""
    actors = log.ticks[row_at(log, moment_s)].actors
    rows = [actors.row(one) for one in (log.settings.ego_id, CONFLICT_ID)]
    return np.asarray(actors.boxes.center[rows, :2].mean(axis=0))


def row_at(log: dsrc.EpisodeLog, time_s: float) -> int:
    """Return the first step from a time on, the last one where there is none."""
    return next((row for row, tick in enumerate(log.ticks) if tick.actors.time_s >= time_s), len(log) - 1)


def from_above(axes: Axes, log: dsrc.EpisodeLog, moment_s: float, middle: np.ndarray) -> None:
    """Draw all actors and the ego's tracks a while before an instant, and ego and conflict actor at it."""
    settings = log.settings
    for edge in read_network(network_file(settings.scenario, settings.seed)).getEdges(withInternal=True):
        for lane in edge.getLanes():
            outline = LineString(lane.getShape()).buffer(0.5 * lane.getWidth(), cap_style="flat")
            axes.add_patch(Polygon(np.array(outline.exterior.coords), facecolor=ROAD, edgecolor="none"))
    end = row_at(log, moment_s)
    now = row_at(log, moment_s - BEFORE_S)
    tick, at_end = log.ticks[now], log.ticks[end]
    for corners, one in zip(tick.actors.boxes.bev_polygons(), tick.actors.boxes.object_id.tolist(), strict=True):
        color = {settings.ego_id: EGO, CONFLICT_ID: CONFLICT}.get(one, OTHER)
        axes.add_patch(Polygon(corners, facecolor=color, edgecolor=PAGE, linewidth=0.7))
    for corners in tick.tracks.boxes.bev_polygons():
        axes.add_patch(Polygon(corners, fill=False, edgecolor=HIGHLIGHT, linewidth=1.6))
    for one, color in ((settings.ego_id, EGO), (CONFLICT_ID, CONFLICT)):
        way = np.array([t.actors.boxes.center[t.actors.row(one), :2] for t in log.ticks[: end + 1]])
        axes.plot(*way.T, color=color, linewidth=1.0)
        corners = at_end.actors.boxes.bev_polygons()[at_end.actors.row(one)]
        axes.add_patch(Polygon(corners, fill=False, edgecolor=color, linewidth=1.4))
    wide, high = REACH_M
    axes.set(xlim=(middle[0] - wide, middle[0] + wide), ylim=(middle[1] - high, middle[1] + high), aspect="equal")
    axes.set(xticks=[], yticks=[], facecolor=PAGE)


def speeds(axes: Axes, log: dsrc.EpisodeLog, moment_s: float) -> None:
    """Draw the speed of the ego over time, from when on it tracked the conflict actor, and the instant above."""
    times = np.array([tick.ego.time_s for tick in log.ticks]) - start_s(log)
    axes.plot(times, [tick.ego.speed_mps for tick in log.ticks], color=EGO)
    tracked_s = dsrc.episode_metrics(log).tracked_s
    if not np.isnan(tracked_s):
        axes.axvline(tracked_s, color=HIGHLIGHT, linewidth=1.0)
        axes.text(tracked_s, 1.0, "tracks it ", color=HIGHLIGHT, fontsize=8, ha="right")
    contact_s = moment_s - start_s(log)
    axes.axvline(contact_s, color=FAINT, linewidth=1.0, linestyle=":")
    axes.text(contact_s, 14.0, " contact" if log.contact else " contact in the other drive", color=FAINT, fontsize=8)
    axes.set(xlabel="time, s", ylabel="speed, m/s", xlim=(0.0, 12.0), ylim=(0.0, 16.0))
    axes.grid(visible=True)


if __name__ == "__main__":
    main()
