"""Draw the radio channel: who is heard how far away, and what messages cost.

Usage:
    python -m studies.pictures.channel --out docs/pictures/channel
"""

import sys
from dataclasses import replace as changed
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from sim.radio import PRESETS, Channel, Obstruction, RadioSnapshot, delivery_probability, get_channel, packet_count

RADIO = ("its-g5-6", "its-g5-27", "c-v2x")
COLOURS = dict(zip(RADIO, ("#0072b2", "#d55e00", "#009e73"), strict=True))
STYLES = {Obstruction.FREE: "-", Obstruction.VEHICLE: "--", Obstruction.BUILDING: ":"}
NAMES = {Obstruction.FREE: "free", Obstruction.VEHICLE: "a vehicle between", Obstruction.BUILDING: "a building between"}
SIZES = {"boxes of 10 objects": 506, "features, compressed to 1.06 Mb": 132_500, "a cloud of 60,000 points": 960_000}


def main(out: Path = Path("docs/pictures/channel"), frames: int = 60) -> None:
    """Draw the radio channel: who is heard how far away, and what messages cost.

    Args:
        out: folder of the PNG files.
        frames: messages of each sender at 10 Hz, more than 25; the first 25 are not counted.
    """
    out.mkdir(parents=True, exist_ok=True)
    for name, figure in {"delivery": delivery(), "messages": messages(frames)}.items():
        figure.savefig(out / f"{name}.png", dpi=110, metadata={"Software": None})
        sys.stdout.write(f"{out / name}.png\n")


def delivery() -> Figure:
    """Draw the probability that a packet arrives, by distance and what is between."""
    figure, axes = plt.subplots(figsize=(8.0, 3.6), layout="constrained")
    distance = np.linspace(2.0, 500.0, 250)
    for name in RADIO:
        for sight, style in STYLES.items():
            chance = [100.0 * delivery_probability(get_channel(name), d, sight) for d in distance]
            axes.plot(distance, chance, style, color=COLOURS[name], label=f"{name}, {NAMES[sight]}")
    axes.axvline(70.0, color="0.6", linewidth=0.8)
    axes.set_xticks([0.0, 70.0, 150.0, 200.0, 300.0, 400.0, 500.0])
    axes.set(xlabel="distance, m", ylabel="packets that arrive, %", ylim=(0.0, 102.0), xlim=(0.0, 500.0))
    axes.legend(fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)
    return figure


def messages(frames: int) -> Figure:
    """Draw how old messages are and how many senders are heard, by the number of agents that send."""
    figure, rows = plt.subplots(2, len(SIZES), figsize=(9.5, 4.6), sharex=True, layout="constrained")
    agents = np.arange(2, 11)
    for column, (title, size) in enumerate(SIZES.items()):
        for name in RADIO:
            age, heard = np.array([_measured(name, int(count), size, frames) for count in agents]).T
            rows[0, column].plot(agents, 1e3 * age, "o-", markersize=3, color=COLOURS[name], label=name)
            rows[1, column].plot(agents, 100.0 * heard, "o-", markersize=3, color=COLOURS[name])
        packets = packet_count(PRESETS["its-g5-6"], size)
        rows[0, column].set_title(f"{title}\n{size / 1000:.3g} kB, {packets} packet{'s' * (packets > 1)}", fontsize=9)
        rows[1, column].set(xlabel="agents that send", ylim=(-3.0, 103.0))
    _label(rows[0, 0], "age when used, ms")
    _label(rows[1, 0], "senders heard, %")
    rows[0, 0].legend(fontsize=8, frameon=False)
    for axes in rows[0]:
        axes.set_ylim(bottom=0.0)
    return figure


def _label(axes: Axes, text: str) -> None:
    axes.set_ylabel(text)


def _measured(name: str, count: int, size: int, frames: int) -> tuple[float, float]:
    """Return the mean age of the messages that an agent uses, s, and the share of the others that it hears.

    The agents stand around a junction, 20 to 60 m apart, in free sight.
    """
    channel = Channel(PRESETS[name], 0, 0.1)
    angle = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    place = np.stack([30.0 * np.cos(angle), 30.0 * np.sin(angle), np.full(count, 1.9)], axis=1)
    first = RadioSnapshot(0, tuple(range(count)), place, (size,) * count, np.zeros((count, count), np.int8))
    drive = [changed(first, index=index) for index in range(frames)]
    links = [channel.newest(drive[now::-1], sender, 0) for now in range(25, frames) for sender in range(1, count)]
    ages = [link.age_s for link in links if link.received]
    return float(np.mean(ages)) if ages else np.nan, len(ages) / len(links)


if __name__ == "__main__":
    tyro.cli(main)
