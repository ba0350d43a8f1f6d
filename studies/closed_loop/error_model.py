"""Collision rates of an error model beside those of the real loop: the same encounters and seeds, other seeds to fit.

The seeds are halved: a model that was fitted to the episodes of one half drives those of the other. The folder is
that of `dsrc drive CAMPAIGN.toml --out runs/real`.

Usage:
    python -m studies.closed_loop.error_model --real runs/real --out docs/pictures/closed_loop
"""

import argparse
from collections import defaultdict
from pathlib import Path

import dsrc
from dsrc.closed_loop.metrics.statistics import Estimate, rate
from dsrc.closed_loop.perception.error_model.perception import ModelPerception
from dsrc.closed_loop.perception.error_model.recordings import fit_model
from dsrc.closed_loop.types import Outcome
from studies.look import COLORS, HIGHLIGHT, new_figure, save, style

Key = tuple[str, str, int]
"""Perception, scenario and seed of an episode."""


def main() -> None:
    description, _, usage = (__doc__ or "").partition("\n\n")
    parser = argparse.ArgumentParser(
        description=description, epilog=usage, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--real", type=Path, required=True, help="folder of a campaign of clean episodes")
    parser.add_argument("--out", type=Path, required=True, help="folder of the picture")
    options = parser.parse_args()
    logs = [dsrc.EpisodeLog.load(path) for path in sorted((options.real / "episodes").glob("*.npz"))]
    real = {key_of(log): log for log in logs if log.settings.corruption == "clean" and log.settings.detector}
    modelled = drive(options.real, real)
    rows = compare({key: log.outcome for key, log in real.items()}, modelled)
    for (name, scenario), (ours, theirs) in rows.items():
        inside = ours.low <= theirs.value <= ours.high
        print(f"{name:6s} {scenario:20s} real {shown(ours)}  model {shown(theirs)}  {'' if inside else 'outside'}")
    print(draw(rows, options.out / "error_model.png"))


def key_of(log: dsrc.EpisodeLog) -> Key:
    return log.settings.perception, log.settings.scenario.name, log.settings.seed


def drive(folder: Path, real: dict[Key, dsrc.EpisodeLog]) -> dict[Key, Outcome]:
    """Return the outcomes of the same episodes with models that have not seen their seeds."""
    outcomes = {}
    for name in sorted({name for name, _, _ in real}):
        seeds = sorted({seed for one, _, seed in real if one == name})
        for half in (seeds[0::2], seeds[1::2]):
            model = fit_model(folder, name, seeds=tuple(seed for seed in seeds if seed not in half))
            perception = ModelPerception(model, model.conditions[0])
            for key, log in real.items():
                if key[0] == name and key[2] in half:
                    settings = dsrc.LoopSettings(**log.settings.loop)
                    loop = dsrc.ClosedLoop(log.settings.scenario, perception, settings=settings)
                    outcomes[key] = loop.run(key[2])
    return outcomes


def compare(real: dict[Key, Outcome], modelled: dict[Key, Outcome]) -> dict[tuple[str, str], tuple[Estimate, Estimate]]:
    """Return the collision rates of both by perception and scenario, over episodes that met their encounter."""
    crashes: dict[tuple[str, str], tuple[list[float], list[float]]] = defaultdict(lambda: ([], []))
    for (name, scenario, seed), _ in sorted(real.items()):
        for column, outcomes in enumerate((real, modelled)):
            outcome = outcomes[name, scenario, seed]
            if outcome != Outcome.DESYNCHRONISED:
                for row in (scenario, "all"):
                    crashes[name, row][column].append(float(outcome == Outcome.CRASHED))
    rows = sorted(crashes.items(), key=lambda item: (item[0][0], item[0][1] == "all", item[0][1]))
    return {row: (rate(ours), rate(theirs)) for row, (ours, theirs) in rows}


def shown(one: Estimate) -> str:
    return f"{100 * one.value:3.0f} % ({100 * one.low:.0f} to {100 * one.high:.0f})"


def draw(rows: dict[tuple[str, str], tuple[Estimate, Estimate]], path: Path) -> Path:
    """Draw the rates with their 95 % intervals, a line per perception and scenario."""
    with style():
        note = "Bars: 95 % intervals (Wilson). The model was fitted to other seeds of the same encounters."
        figure = new_figure(8.4, 1.6 + 0.42 * len(rows), "Collision rates: real loop and error model", note)
        axes = figure.add_subplot()
        for line, estimates in enumerate(rows.values()):
            for shift, color, one in zip((-0.13, 0.13), (COLORS[0], HIGHLIGHT), estimates, strict=True):
                at = line + shift
                axes.plot([100 * one.low, 100 * one.high], [at, at], color=color, linewidth=2.0)
                axes.plot(100 * one.value, at, "o", color=color, markersize=6)
        for label, color in (("real loop", COLORS[0]), ("error model", HIGHLIGHT)):
            axes.plot([], [], "o-", color=color, label=label)
        axes.set_yticks(range(len(rows)), [f"{name}: {scenario}" for name, scenario in rows])
        axes.invert_yaxis()
        axes.set(xlim=(-2, 102), xlabel="collision rate, %")
        axes.legend(loc="upper left")
        return save(figure, path, colors=64, keep=[COLORS[0], HIGHLIGHT])


if __name__ == "__main__":
    main()
