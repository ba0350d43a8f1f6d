"""Tables of scores: those of other benchmarks side by side with time and comfort, and routes with and without a hazard.

Sources: success rate and driving score of the CARLA leaderboard and of Jia et al., *Bench2Drive*, NeurIPS 2024 (a route
completed in time without an infraction); PDMS of Dauner et al., *NAVSIM*, NeurIPS 2024; paired routes of Gerstenecker,
Geiger and Renz, *Fail2Drive*, arXiv 2604.08535, 2026: the drop of the success rate and of the driving score between a
route and its counterpart.
"""

from collections.abc import Sequence

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.metrics.comparison import Result, arrived, counted, metric
from dsrc.closed_loop.metrics.statistics import mean, paired_rates, rate
from dsrc.closed_loop.report.cells import condition, groups, number, score, share

HAZARD_FREE = ("no_conflict", "no_occluder")
"""Controls of an encounter that are its route without its hazard: nobody comes, or nothing hides who comes."""


def success(one: Result) -> float:
    """Return 1 for an arrival without a collision and without a red light run, else 0."""
    return float(arrived(one) == 1.0 and metric(one, "collision") == 0.0 and not metric(one, "red_lights") > 0.0)


SCORE_HEADS = (
    *("perception", "condition", "episodes", "success", "score 2.0", "score 2.1", "PDMS", "EPDMS", "comfort"),
    *("s to arrive", "hardest brake m/s²", "first sight s", "its track s", "tracking loss"),
)


def score_rows(results: Sequence[EpisodeResult]) -> list[tuple[str, ...]]:
    """Return a row per perception and condition: the scores of its episodes that met their encounter."""
    rows: list[tuple[str, ...]] = []
    for perception, title, group in groups(results):
        met = _met(group)
        there = [one for one in met if arrived(one)]
        names = ("driving_score_2_0", "driving_score_2_1", "pdms", "epdms", "comfort")
        means = [mean([metric(one, name) for one in met]) for name in names]
        numbers = (
            share(rate([success(one) for one in met])),
            *(score(one) for one in means),
            number(mean([metric(one, "duration_s") for one in there])),
            number(mean([metric(one, "hardest_brake_mps2") for one in met])),
            number(mean([metric(one, "seen_s") for one in met])),
            number(mean([metric(one, "tracked_s") for one in met])),
            number(mean([metric(one, "tracking_loss") for one in met])),
        )
        rows.append((perception, title, str(len(met)), *numbers))
    return rows


HAZARD_HEADS = (
    *("perception", "condition", "without", "pairs", "success without", "success with", "more successes"),
    *("more score 2.1", "more s"),
)


def hazard_rows(results: Sequence[EpisodeResult]) -> list[tuple[str, ...]]:
    """Return a row per perception, condition and control: a route with its hazard beside it without, seed by seed.

    Time is of the pairs in which both arrive.
    """
    known = {(one.scenario, one.perception, condition(one), one.seed): one for one in _met(results)}
    rows: list[tuple[str, ...]] = []
    for perception, title, group in groups(results):
        for control in HAZARD_FREE:
            found = [
                (one, known[key])
                for one in _met(group)
                if (key := (f"{one.scenario}:{control}", perception, title, one.seed)) in known
            ]
            if not found:
                continue
            here, without = ([success(pair[side]) for pair in found] for side in (0, 1))
            gained = [metric(a, "driving_score_2_1") - metric(b, "driving_score_2_1") for a, b in found]
            both = [(a, b) for a, b in found if arrived(a) and arrived(b)]
            longer = [metric(a, "duration_s") - metric(b, "duration_s") for a, b in both]
            clusters = [(one.scenario, one.seed) for one, _ in found]
            drop = paired_rates(here, without, clusters=clusters).difference
            rates = (share(rate(without)), share(rate(here)), share(drop, signed=True))
            more = (score(mean(gained)), number(mean(longer)))
            rows.append((perception, title, control, str(len(found)), *rates, *more))
    return rows


def _met(results: Sequence[EpisodeResult]) -> list[EpisodeResult]:
    """Return the episodes that met their encounter, those with a failed perception too."""
    return [one for one in results if counted([one], failed=True)]
