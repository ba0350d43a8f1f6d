"""Table attack x defence: what lies of helpers did, and whom the defences refused."""

from collections.abc import Sequence

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.metrics.comparison import arrived, collided, counted, metric
from dsrc.closed_loop.metrics.statistics import mean, rate
from dsrc.closed_loop.report.cells import percent, share
from sim.radio import IDEAL

LIE_HEADS = (
    *("perception", "attack", "defence", "episodes", "met", "crashed", "needless stops", "arrived"),
    *("attacks refused", "wrongly refused"),
)


def lie_rows(results: Sequence[EpisodeResult]) -> list[tuple[str, ...]]:
    """Return a row per perception, what is wrong and defence."""
    groups: dict[tuple[str, str, str], list[EpisodeResult]] = {}
    for one in results:
        attack = one.disturbance if one.channel == IDEAL else f"{one.disturbance}, {one.channel}"
        groups.setdefault((one.perception, attack, one.defence.replace(",", ", ") or "none"), []).append(one)
    return [(*key, *_cells(group)) for key, group in groups.items()]


def _cells(group: Sequence[EpisodeResult]) -> tuple[str, ...]:
    known = [one for one in group if metric(one, "needless_stops") >= 0.0]  # not of a failed perception
    told = [one for one in group if metric(one, "false_told") > 0.0]
    refused = mean([metric(one, "false_refused") / metric(one, "false_told") for one in told])
    helpers, wronged = (
        sum(int(metric(one, name)) for one in group if metric(one, name) >= 0.0)
        for name in ("helpers_honest", "helpers_wronged")
    )
    return (
        str(len(group)),
        str(len(counted(group))),
        share(rate([collided(one) for one in counted(group)])),
        share(rate([float(metric(one, "needless_stops") > 0.0) for one in known])),
        share(rate([arrived(one) for one in group])),
        percent(refused.value) if refused.low != refused.low else share(refused),
        share(rate([1.0] * wronged + [0.0] * (helpers - wronged))),
    )
