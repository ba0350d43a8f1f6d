"""Episodes of the environment with a car-following policy, one row of results per seed."""

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from rich.table import Table

from dsrc.closed_loop.env import LOOK_AHEAD, CoopDrivingEnv, Observation
from dsrc.closed_loop.idm import IdmSettings, idm_acceleration
from dsrc.closed_loop.former_perception import DetectorPerception, Perception, TruthPerception
from sensors.corruptions import CLEAN, DEFAULT_SEVERITY, Family, require_corruption
from sim.errors import SettingsError
from sim.files import write_file
from sim.radio import IDEAL, get_channel

PerceptionKind = Literal["truth", "ego", "dsrc"]

SHIPPED_DETECTOR = Path(__file__).parents[1] / "checkpoints" / "small-dsrc.pt"


@dataclass(frozen=True, slots=True)
class Episode:
    """Results of one episode; lengths in m, times in s, speeds in m/s."""

    scenario: str
    perception: str
    corruption: str
    severity: int
    seed: int
    duration_s: float
    progress_m: float
    mean_speed_mps: float
    collision: bool
    collided_with: int
    min_ttc_s: float
    hardest_brake_mps2: float
    family: str
    channel: str


def idm_policy(observation: Observation, settings: IdmSettings | None = None) -> NDArray[np.float32]:
    """Action (1,) of the IDM follower behind the perceived obstacle in its corridor."""
    settings = settings or IdmSettings()
    gap = float(observation["gap"][0])
    acceleration = idm_acceleration(
        speed=float(observation["speed"][0]),
        desired_speed=float(observation["desired_speed"][0]),
        gap=math.inf if gap >= LOOK_AHEAD else gap,
        lead_speed=float(observation["lead_speed"][0]),
        settings=settings,
    )
    limit = settings.max_acceleration if acceleration > 0.0 else settings.max_deceleration
    return np.array([acceleration / limit], np.float32)


def drive_episode(
    env: CoopDrivingEnv, seed: int, progress: Callable[[int, int], None] | None = None
) -> tuple[dict, float]:
    """Drive one episode; return the last `info` and the hardest braking, m/s2."""
    observation, info = env.reset(seed=seed)
    steps, hardest, done = round(env.duration_s / env.scenario.step_s), 0.0, False
    count = 0
    while not done:
        before = float(observation["speed"][0])
        observation, _, terminated, truncated, info = env.step(idm_policy(observation, env.idm))
        if not info["collided_with"]:  # what a crash does to the speed is no braking
            hardest = max(hardest, (before - float(observation["speed"][0])) / env.scenario.step_s)
        done = terminated or truncated
        count += 1
        if progress is not None:
            progress(count, steps)
    return {**info, "duration_s": count * env.scenario.step_s}, hardest


def drive_episodes(
    scenario: str,
    *,
    perception: PerceptionKind = "truth",
    checkpoint: Path | None = None,
    corruption: str = CLEAN,
    severity: int = DEFAULT_SEVERITY,
    family: Family = "physical",
    seeds: Sequence[int] = (0,),
    duration_s: float = 20.0,
    channel: str = IDEAL,
    out: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Table:
    """Drive one episode per seed and return them as a table; written to `out` as CSV when given.

    Args:
        scenario: name or path.
        perception: the truth, the ego's detector alone, or with collaborators.
        checkpoint: a detector; default: the shipped one.
        corruption: kind or `clean`.
        severity: 1 to 5.
        family: of the corruption's settings.
        seeds: one episode each.
        duration_s: longest episode, s.
        channel: preset of the radio channel.
        out: CSV file, replaced as a whole.
        progress: called with (steps done, steps in all).

    Raises:
        UserError: a setting, the scenario or the checkpoint is wrong.
    """
    if not math.isfinite(duration_s) or duration_s <= 0.0:
        raise SettingsError(f"drive: duration_s: expected seconds > 0, found {duration_s}")
    if not seeds or min(seeds) < 0:
        raise SettingsError(f"drive: seed: expected one or more integers >= 0, found {tuple(seeds)}")
    if out is not None:
        # A place that cannot be written to must not cost an episode.
        out.parent.mkdir(parents=True, exist_ok=True)
    eyes = make_perception(perception, checkpoint, corruption, severity, family, channel)
    env = CoopDrivingEnv(scenario, eyes, duration_s)
    total = len(seeds) * round(duration_s / env.scenario.step_s)
    rows = []
    for number, seed in enumerate(seeds):
        base = number * round(duration_s / env.scenario.step_s)
        follow = None if progress is None else lambda done, _, base=base: progress(base + done, total)
        try:
            info, hardest = drive_episode(env, seed, follow)
        finally:
            env.close()
        rows.append(
            Episode(
                scenario=env.scenario.name,
                perception=perception,
                corruption=corruption,
                severity=0 if corruption == CLEAN else severity,
                seed=seed,
                duration_s=round(info["duration_s"], 3),
                progress_m=round(info["progress_m"], 2),
                mean_speed_mps=round(info["progress_m"] / info["duration_s"], 2),
                collision=bool(info["collided_with"]),
                collided_with=info["collided_with"][0] if info["collided_with"] else -1,
                min_ttc_s=round(info["min_ttc_s"], 2),
                hardest_brake_mps2=round(hardest, 2),
                family="" if corruption == CLEAN else family,
                channel=channel,
            )
        )
        if out is not None:
            _write_csv(out, rows)
    if progress is not None:
        progress(total, total)
    return _table(rows)


def make_perception(
    kind: PerceptionKind,
    checkpoint: Path | None,
    corruption: str = CLEAN,
    severity: int = DEFAULT_SEVERITY,
    family: Family = "physical",
    channel: str = IDEAL,
) -> Perception:
    """Return the perception of that kind.

    Raises:
        SettingsError: a corruption, a detector or a channel of who does not use it, or an unknown one of them.
        DataError: the trace of a channel cannot be read.
        CheckpointError: the checkpoint is missing or wrong.
    """
    require_corruption(corruption, severity, family)
    spec = get_channel(channel)
    if kind != "dsrc" and channel != IDEAL:
        raise SettingsError(
            f"drive: channel: expected '{IDEAL}' with perception '{kind}' (no messages), found '{channel}'"
        )
    if kind == "truth":
        if corruption != CLEAN:
            raise SettingsError(
                f"drive: corruption: expected 'clean' with perception 'truth' (no sensor), found '{corruption}'"
            )
        if checkpoint is not None:
            raise SettingsError(
                f"drive: checkpoint: expected none with perception 'truth' (no detector), found '{checkpoint}'"
            )
        return TruthPerception()
    from dsrc.models.storage.checkpoint import load_student

    detector = load_student(checkpoint or SHIPPED_DETECTOR)
    return DetectorPerception(detector, kind == "dsrc", corruption, severity, family, spec)


def _write_csv(path: Path, rows: list[Episode]) -> None:
    text = io.StringIO()
    writer = csv.DictWriter(text, fieldnames=list(asdict(rows[0])), lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    write_file(path, text.getvalue())


def _table(rows: list[Episode]) -> Table:
    first = rows[0]
    through = "" if first.channel == IDEAL else f", through {first.channel}"
    table = Table(title=f"{first.scenario}: perception {first.perception}, {first.corruption}{through}")
    for heading in ("seed", "seconds", "progress m", "mean m/s", "collision", "min TTC s", "hardest brake m/s²"):
        table.add_column(heading, justify="right")
    for row in rows:
        table.add_row(
            str(row.seed),
            f"{row.duration_s:.1f}",
            f"{row.progress_m:.1f}",
            f"{row.mean_speed_mps:.1f}",
            f"yes, {row.collided_with}" if row.collision else "no",
            f"{row.min_ttc_s:.1f}",
            f"{row.hardest_brake_mps2:.1f}",
        )
    return table
