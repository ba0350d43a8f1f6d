"""Tables of a campaign, a section of its report each."""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import combinations

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.plan import Campaign
from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.metrics.comparison import (
    Result,
    Value,
    arrived,
    avoidable,
    collided,
    corruption_errors,
    counted,
    gain_per_megabyte,
    harm_rate,
    mean_corruption_error,
    metric,
    pairs,
)
from dsrc.closed_loop.metrics.statistics import PairedRates, mean, paired_rates, rate
from dsrc.closed_loop.perception.open import ALONE, TELLING, WITHOUT_SENSOR
from dsrc.closed_loop.report.cells import (
    COLUMNS,
    HARSH_MPS2,
    condition,
    condition_cells,
    groups,
    number,
    percent,
    scenario_title,
    share,
)
from dsrc.closed_loop.report.findings import NOTHING, Findings, counted_causes, joined_calibrations
from dsrc.closed_loop.report.gate import GATE_NAMES
from dsrc.closed_loop.report.lies import LIE_HEADS, lie_rows
from dsrc.closed_loop.report.scores import HAZARD_HEADS, SCORE_HEADS, hazard_rows, score_rows
from dsrc.closed_loop.types import FAILED, Outcome
from dsrc.faults.fault import parse_faults
from dsrc.tables.table import Column, Strong, Table, TableRow
from sensors.corruptions import CLEAN

NAMES = {
    **GATE_NAMES,
    "conditions": "All scenarios",
    "apart": "Without a class",
    "crashed": "Crashed",
    "arrived": "Arrived",
    "scenarios": "By scenario, clean",
    "differences": "Paired crashes",
    "arrivals": "Paired arrivals",
    "pace": "Time and braking at equal safety",
    "scores": "Scores, time and comfort",
    "hazards": "Routes with and without their hazard",
    "lies": "Attacks and defences",
    "robustness": "Closed-loop corruption error",
    "reasons": "Causes of crashes",
    "causes": "What came late",
    "calibration": "Calibration of the detections",
    "hardest": "Hardest crashes",
    "controls": "Controls",
}
"""Titles of the tables by name."""
_OF_ONE_CHANNEL = ("crashed", "arrived", "scenarios", "arrivals", "pace", "robustness", "causes")
ALL_CORRUPTIONS = "all corruptions"
"""Title of the episodes under several corruptions together."""
_WORST = 12
_SEEN_S = 1.5
"""Least time between the first box of the conflict actor and the crash: who drives 40 km/h stops in it, at 8 m/s2."""
_TRACKED_S = 0.4
"""Most time between its first box and its track: two more percepts at 5 Hz."""
_SMALL_P = 0.05
_PAIRED = (
    "Paired episodes of one encounter and seed are a cluster: the p-value is that of the exact test that swaps both "
    "perceptions of clusters, without a correction for the number of tests."
)


def tables(result: CampaignResult, more: Findings = NOTHING) -> dict[str, Table]:
    """Tables that a campaign has results for, by name, those of its gate first."""
    common, apart = parts_of(result)
    first = result.plan.radios[0]
    plain = [[one for one in part if one.channel == first] for part in (common, apart)]
    of_first = of_first_channel(result.plan, common)
    found = [
        *more.gate.tables(),
        _all_scenarios(result, common),
        _apart(result, apart),
        _crashed(of_first),
        _arrived(of_first),
        _scenarios(plain),
        _differences(result.plan, common),
        _arrivals(result.plan, of_first),
        _pace(result.plan, plain[0]),
        _scores(common),
        _hazards(common),
        _lies(result),
        _robustness(result.plan, plain[0]),
        _reasons(result.results, more),
        _causes(of_first),
        _calibration(common or apart, more),
        _worst(result),
        _controls(result),
    ]
    through = f" Through the channel `{first}`." if len(result.plan.radios) > 1 else ""
    return {
        one.name: replace(one, note=one.note + through) if one.name in _OF_ONE_CHANNEL else one
        for one in found
        if one.rows or one.note
    }


def of_first_channel(plan: Campaign, results: Sequence[EpisodeResult]) -> list[EpisodeResult]:
    """Return the episodes through the first channel of a campaign, as it is or with a fault of the radio."""
    own = {each.channel for each in plan.disturbed(plan.radios[0])}
    return [one for one in results if one.channel in own]


def _table(name: str, heads: Sequence[str], rows: Iterable[Sequence[str]], note: str, left: int = 1) -> Table:
    """Table of a campaign; without rows it is empty.

    Args:
        name: one of `NAMES`.
        left: number of columns of words.
    """
    listed = tuple(TableRow(first, tuple(cells)) for first, *cells in rows)
    columns = [Column(head, align="left" if place < left else "right") for place, head in enumerate(heads)]
    return Table(name, NAMES[name], heads[0], tuple(columns[1:]), listed, note if listed else "")


def parts_of(result: CampaignResult) -> tuple[list[EpisodeResult], list[EpisodeResult]]:
    """Return the episodes that all perceptions of a campaign have the classes for, and the others.

    A comparison over the others would compare classes: who has none for a pedestrian is blind by construction.
    """
    unknown = {(one.scenario, one.seed) for one in result.results if not one.detectable}
    apart = [one for one in result.results if (one.scenario, one.seed) in unknown]
    return [one for one in result.results if (one.scenario, one.seed) not in unknown], apart


def _all_scenarios(result: CampaignResult, common: Sequence[EpisodeResult]) -> Table:
    driven = all(one.outcome != Outcome.DRIVER_FAILED for one in result.results)
    text = (
        "Crashed: share of the episodes that met their encounter, with its Wilson interval of 95 %. At fault: crashes "
        "in which the ego neither stood nor was hit from behind. Lost: episodes that never met their encounter, not "
        "counted. Failed: episodes whose perception "
        f"{'' if driven else 'or driver '}failed, not counted either. Score: CARLA's driving score 2.1, with "
        "a bootstrap interval. Progress: share of the reference distance."
    )
    if result.careful:
        own = [collided(one) for one in counted(result.careful)]
        text += (
            " Avoidable: share of the crashes that the careful driver of UN R157 avoids on the same seeds when it "
            f"knows the truth, with its Wilson interval. That driver itself crashes in {sum(own):.0f} of {len(own)} "
            "episodes."
        )
    return _conditions("conditions", result, common, text)


def _apart(result: CampaignResult, apart: Sequence[EpisodeResult]) -> Table:
    """Table of the episodes that a perception has no class for."""
    users = sorted({one.road_user for one in apart})
    kinds = " and ".join("buses" if kind == "bus" else f"{kind}s" for kind in users)
    text = (
        f"Encounters with {kinds}, which some perceptions have no class for: no part of the other tables, but "
        "for those by scenario and of the hardest crashes. No class: episodes in which the perception is blind for the "
        "conflict actor for that reason."
    )
    return replace(_conditions("apart", result, apart, text, blind=True), title=kinds.capitalize())


def _crashed(results: Sequence[EpisodeResult]) -> Table:
    def cell(title: str, met: Sequence[Result]) -> str:
        found = rate([collided(one) for one in met])
        return percent(found.value) if title == ALL_CORRUPTIONS else share(found)

    table = _by_condition("crashed", results, cell)
    text = "Share of the episodes that met their encounter, with its Wilson interval of 95 %."
    if any(column.title == ALL_CORRUPTIONS for column in table.columns):
        text += f" Without one, {ALL_CORRUPTIONS}: episodes of one encounter and seed are alike."
    return replace(table, note=text if table.rows else "")


def _arrived(results: Sequence[EpisodeResult]) -> Table:
    def cell(_: str, met: Sequence[Result]) -> str:
        return f"{sum(arrived(one) for one in met):.0f} of {len(met)}"

    return _by_condition("arrived", results, cell, "Of the episodes that met their encounter.", failed=True)


def _by_condition(
    name: str,
    results: Sequence[EpisodeResult],
    cell: Callable[[str, Sequence[Result]], str],
    note: str = "",
    failed: bool = False,
) -> Table:
    """Table with a row per perception and a column per condition."""
    by_perception = {
        name: _conditions_of([one for one in results if one.perception == name])
        for name in dict.fromkeys(one.perception for one in results)
    }
    titles = list(dict.fromkeys(title for groups_of in by_perception.values() for title in groups_of))
    rows = [
        (name, *(cell(title, counted(own[title], failed)) if title in own else "" for title in titles))
        for name, own in by_perception.items()
    ]
    return _table(name, ["perception", *titles], rows, note)


def _conditions(
    name: str, result: CampaignResult, results: Sequence[EpisodeResult], note: str, blind: bool = False
) -> Table:
    """Table with a row per perception and condition."""
    more = (["avoidable"] if result.careful else []) + (["no class"] if blind else [])
    rows = []
    for perception, title, group in groups(results):
        avoided = [share(rate(avoidable(group, result.careful)))] if result.careful else []
        unknown = [str(sum(not one.detectable for one in group))] if blind else []
        rows.append((perception, title, *condition_cells(group), *avoided, *unknown))
    return _table(name, ["perception", "condition", *(column.title for column in COLUMNS), *more], rows, note, left=2)


def _scenarios(parts: Sequence[Sequence[EpisodeResult]]) -> Table:
    """Table of the clean collision rates by scenario and perception, marked where it has no class.

    Args:
        parts: of one channel, the episodes for all perceptions and those that are apart.
    """
    common, apart = parts
    rows = []
    names = list(dict.fromkeys(one.perception for one in (*common, *apart)))
    for part, results in (("", common), ("apart", apart)):
        clean = [one for one in results if one.clean]
        for scenario in dict.fromkeys(one.scenario for one in clean):
            group = [one for one in clean if one.scenario == scenario]
            title = scenario_title(scenario) + (f" ({group[0].road_user})" if part else "")
            rows.append((title, *(_crashes([one for one in group if one.perception == name]) for name in names)))
    text = "Crashes, clean, of the episodes that met their encounter, with the Wilson interval of 95 %." + (
        " *: no class for the road user." if apart else ""
    )
    return _table("scenarios", ["scenario", *names], rows, text)


def _crashes(group: Sequence[EpisodeResult]) -> str:
    """Return the collision rate of some episodes, and how many were stuck, lost or failed."""
    met = counted(group)
    kinds = {"stuck": (Outcome.STUCK,), "lost": (Outcome.DESYNCHRONISED,), "failed": FAILED}
    counts = {what: sum(one.outcome in ends for one in group) for what, ends in kinds.items()}
    rates = share(rate([collided(one) for one in met]))
    text = ", ".join([rates, *(f"{count} {what}" for what, count in counts.items() if count)])
    return text if all(one.detectable for one in group) else f"{text} *"


def _differences(plan: Campaign, results: Sequence[EpisodeResult]) -> Table:
    """Table of what each perception gains over `ego`, the detector without helpers, over paired episodes."""
    alone = _alone(plan)
    base = [one for one in results if one.perception == alone]
    rows = []
    for name in dict.fromkeys(one.perception for one in results if alone is not None and one.perception != alone):
        for title, group in _conditions_of([one for one in results if one.perception == name]).items():
            matched = pairs(group, base, any_channel=True)
            if not matched:
                continue
            found = _paired(matched, collided)
            together, single = [a for a, _ in matched], [b for _, b in matched]
            gain = gain_per_megabyte(together, single)
            numbers = (
                share(found.difference, signed=True),
                _p_value(found.p_value),
                percent(harm_rate(together, single)),
                "" if gain != gain else f"{gain:.3f}",
            )
            rows.append((name, title, str(len(matched)), *numbers))
    heads = ["perception", "condition", "pairs", f"crashes less those of {alone}", "p", "harm rate", "gain per MB"]
    return _table("differences", heads, rows, f"In brackets the interval of 95 %. {_PAIRED}", left=2)


def _arrivals(plan: Campaign, results: Sequence[EpisodeResult]) -> Table:
    """Table of the differences of arrivals between all perceptions with a sensor, a row per pair."""
    names = [one.name for one in plan.perceptions if one.kind not in WITHOUT_SENSOR]
    own = {name: _conditions_of([one for one in results if one.perception == name]) for name in names}
    order = list(dict.fromkeys(title for conditions in own.values() for title in conditions))
    found: dict[str, dict[str, str]] = {}
    for before, after in combinations(names, 2):
        both = [title for title in order if title in own[before] and title in own[after]]
        matched = {title: pairs(own[after][title], own[before][title], failed=True) for title in both}
        found[f"{after} less {before}"] = {
            title: _arrivals_cell(_paired(of_both, arrived)) for title, of_both in matched.items() if of_both
        }
    titles = [title for title in order if any(title in cells for cells in found.values())]
    rows = [(pair, *(cells.get(title, "") for title in titles)) for pair, cells in found.items() if cells]
    text = (
        "Arrivals, percentage points, of the pairs in which both met the encounter; in brackets the episodes in which "
        f"only the first, and only the second, arrives. Bold: p < {_SMALL_P:g}. {_PAIRED}"
    )
    return _table("arrivals", ["", *titles], rows, text)


def _pace(plan: Campaign, results: Sequence[EpisodeResult]) -> Table:
    """Table of what a driver gains with other eyes where it is safe with all of them, clean episodes.

    It is of plans whose perceptions have drivers of their own.
    """
    clean = [one for one in results if one.clean and any(spec.driver for spec in plan.perceptions)]
    driver_of = {spec.name: spec.driver or plan.driver for spec in plan.perceptions}
    rows = []
    for driver in dict.fromkeys(driver_of.values()):
        own = {
            name: {(one.scenario, one.seed): one for one in clean if one.perception == name}
            for name, its in driver_of.items()
            if its == driver
        }
        own = {name: found for name, found in own.items() if found}
        if len(own) < 2:
            continue
        safe = [
            key for key in next(iter(own.values())) if all(key in one and arrived(one[key]) for one in own.values())
        ]
        first = next(iter(own))
        for name, found in own.items():
            here = [found[key] for key in safe]
            seconds, brakes = ([metric(one, field) for one in here] for field in ("duration_s", "hardest_brake_mps2"))
            later = [metric(found[key], "duration_s") - metric(own[first][key], "duration_s") for key in safe]
            rows.append(
                (
                    name,
                    driver,
                    share(rate([collided(one) for one in counted(list(found.values()))])),
                    str(len(safe)),
                    number(mean(seconds)),
                    "" if name == first else number(mean(later), signed=True),
                    number(mean(brakes)),
                    share(rate([brake > HARSH_MPS2 for brake in brakes])),
                    number(mean([metric(one, "mean_speed_mps") for one in here])),
                )
            )
    heads = ["perception", "driver", "crashed", "all arrive", "arrives, s", "less the first", "hardest braking, m/s²"]
    text = (
        "Crashed: of all clean episodes. All else is of those in which the driver arrives with each of its "
        "perceptions, where eyes can give time and comfort alone. Less the first: seconds to arrive less those with "
        f"the driver's first perception, in pairs. Harsh: share of episodes with braking above {HARSH_MPS2:g} m/s². In "
        "brackets the interval of 95 %, Wilson's of shares, bootstrap (BCa) of means."
    )
    return _table("pace", [*heads, "harsh", "m/s"], rows, text, left=2)


def _p_value(value: float) -> str:
    return "< 0.001" if value < 0.001 else f"{value:.3f}"


def _arrivals_cell(found: PairedRates) -> str:
    text = f"{100 * found.difference.value:+.0f} ({found.only_first}, {found.only_second})"
    return Strong(text) if found.p_value < _SMALL_P else text


def _conditions_of(results: Sequence[EpisodeResult]) -> dict[str, list[EpisodeResult]]:
    """Return the episodes of one perception by condition, and those of several corruptions together."""
    found = {title: group for _, title, group in groups(results)}
    corrupted = [one for one in results if one.corruption != CLEAN]
    if len({one.corruption for one in corrupted}) > 1 and len({one.channel for one in corrupted}) == 1:
        found[ALL_CORRUPTIONS] = corrupted
    return found


def _paired(matched: Sequence[tuple[Result, Result]], value: Value) -> PairedRates:
    ours, theirs = ([value(pair[side]) for pair in matched] for side in (0, 1))
    return paired_rates(ours, theirs, clusters=[(one.scenario, one.seed) for one, _ in matched])


def _scores(results: Sequence[EpisodeResult]) -> Table:
    """Table of the scores of other benchmarks, time and comfort."""
    text = (
        "Of the episodes that met their encounter, in brackets the interval of 95 %. Success: arrived without a "
        "collision or a red light run (Bench2Drive). Score: CARLA's driving score 2.0 and 2.1. PDMS: NAVSIM's. "
        "Comfort: share of the steps within nuPlan's bounds. Time: of arrivals. First sight of the conflict actor and "
        "its track: s after the start, of the ego for a perception without messages, of the team for one with them."
    )
    rows = score_rows(results)
    # Results of earlier code lack metrics of today.
    known = [at for at in range(len(SCORE_HEADS)) if not rows or any(row[at] for row in rows)]
    heads, rows = [SCORE_HEADS[at] for at in known], [tuple(row[at] for at in known) for row in rows]
    return _table("scores", heads, rows, text, left=2)


def _hazards(results: Sequence[EpisodeResult]) -> Table:
    """Table of pairs of a route with and without its hazard."""
    text = (
        "Each encounter beside its control on the same seed, the route with its hazard less that without it, as "
        "Fail2Drive pairs routes. Time: pairs in which both arrive."
    )
    return _table("hazards", HAZARD_HEADS, hazard_rows(results), text, left=3)


def _lies(result: CampaignResult) -> Table:
    """Table of what attacks did and what defences refused, of campaigns with either."""
    text = (
        "Of the perceptions whose helpers lie, or that defend themselves. Met: episodes that met their encounter. "
        "Crashed: of these. Needless stops: of all episodes, those in which the ego came to stand for a road user that "
        "is not there. Arrived: of all episodes. Attacks refused: share of the false objects told that was refused, "
        "mean over episodes; who fuses clouds or features refuses none. Wrongly refused: of the helpers that did not "
        "lie, one each episode, those of whom an object was refused. In brackets the interval of 95 %: Wilson's of "
        "shares of episodes and helpers, bootstrap (BCa) over episodes of attacks refused."
    )
    lied_to = {one.name for one in result.plan.perceptions if one.kind in TELLING}
    faulty = [one for one in result.results if one.fault]
    lied_to |= {one.perception for one in faulty if any(part.attack for part in parse_faults(one.fault, "results"))}
    own = [one for one in result.results if one.perception in lied_to] if result.plan.lies else []
    return _table("lies", LIE_HEADS, lie_rows(own), text, left=3)


def _alone(plan: Campaign) -> str | None:
    return next((one.name for one in plan.perceptions if one.kind == ALONE), None)


def _robustness(plan: Campaign, results: Sequence[EpisodeResult]) -> Table:
    """Table of corruption errors of every perception relative to `ego`, the form of mCE."""
    alone = _alone(plan)
    corrupted = [one for one in results if one.corruption != CLEAN and alone is not None]
    kinds = list(dict.fromkeys(one.corruption for one in corrupted))
    base = [one for one in corrupted if one.perception == alone]
    rows = []
    for spec in plan.perceptions:
        if own := [one for one in corrupted if one.perception == spec.name]:
            errors = corruption_errors(own, base)
            values = [mean_corruption_error(errors), *(errors.get(kind, float("nan")) for kind in kinds)]
            rows.append((spec.name, *("" if value != value else f"{value:.2f}" for value in values)))
    text = f"Collision rate under a corruption over that of {alone}; 1 is as bad."
    return _table("robustness", ["perception", "mCE", *kinds], rows, text)


def _reasons(results: Sequence[EpisodeResult], more: Findings) -> Table:
    """Table of the causes of the crashes, each of one log."""
    kinds, counts = counted_causes(results, more.causes)
    rows = [
        (perception, title, str(sum(own.values())), *(str(own[kind]) for kind in kinds))
        for (perception, title), own in counts.items()
    ]
    text = (
        "Crashes by what came first after the last chance, the last step from which full braking avoids the crash. "
        "Unavoidable: the road user came into sight later. Missed: in sight in time, and no box. Seen, tracked, braked "
        "late: the first box, the track, full braking came later. Braked too little: full braking was asked for in "
        "time, and was given up or did not act. Told wrongly: drove for a road user that only a helper's false report "
        "has. The sentence of each crash is in causes.csv."
    )
    return _table("reasons", ["perception", "condition", "crashes", *kinds], rows, text, left=2)


def _causes(results: Sequence[EpisodeResult]) -> Table:
    """Table of what came late in the crashes of encounters: the sight of the conflict actor, its track, or neither."""
    kinds = ("not seen", "seen late", "tracked late", "in time")
    rows = []
    for perception in dict.fromkeys(one.perception for one in results):
        conditions = _conditions_of([one for one in results if one.perception == perception])
        wanted = (CLEAN, ALL_CORRUPTIONS) if ALL_CORRUPTIONS in conditions else conditions
        for title in wanted:
            crashed = [one for one in conditions.get(title, ()) if one.outcome == Outcome.CRASHED.value]
            found = [_late(one) for one in crashed if one.road_user]
            if found:
                rows.append((perception, title, str(len(found)), *(str(found.count(kind)) for kind in kinds)))
    text = (
        "Crashes in encounters, whoever the ego crashed with, by what came late first. Not seen: no percept had a box "
        f"of the conflict actor. Seen late: the first box came less than {_SEEN_S:g} s before the crash. Tracked late: "
        f"its track was confirmed more than {_TRACKED_S:g} s after that, or never. In time: neither."
    )
    return _table("causes", ["perception", "condition", "crashes", *kinds], rows, text, left=2)


def _calibration(results: Sequence[EpisodeResult], more: Findings) -> Table:
    """Table of how often detections in the loop are right, and how far their scores are from it."""
    rows = [
        (perception, title, str(episodes), str(own.count.sum()), percent(own.right), percent(own.error))
        for (perception, title), (episodes, own) in joined_calibrations(results, more.calibrations).items()
    ]
    text = (
        "Detections of the episodes whose logs are there, at the instant of their measurement. Right: those that "
        "overlap a road user by half or more in bird's-eye view. ECE: expected calibration error, the mean gap between "
        "score and share right over detections in ten bins of the score."
    )
    heads = ["perception", "condition", "episodes", "detections", "right", "ECE"]
    return _table("calibration", heads, rows, text, left=2)


def _late(one: EpisodeResult) -> str:
    seen_s, tracked_s, crash_s = (metric(one, name) for name in ("seen_s", "tracked_s", "duration_s"))
    if seen_s != seen_s:
        return "not seen"
    # Times are sums of steps: rounded, so that equal ones are.
    if round(crash_s - seen_s, 6) < _SEEN_S:
        return "seen late"
    return "in time" if round(tracked_s - seen_s, 6) <= _TRACKED_S else "tracked late"


def _worst(result: CampaignResult) -> Table:
    crashed = [one for one in result.results if one.outcome == Outcome.CRASHED.value and one.detectable]
    failed = [one for one in result.results if one.outcome in FAILED]
    columns = [Column("seed"), Column("perception", align="left"), Column("condition", align="left")]
    columns += [Column("closing m/s", digits=1), Column("delta-v m/s", digits=1), Column("log", align="left")]
    rows = tuple(
        TableRow(
            scenario_title(one.scenario),
            (
                *(one.seed, one.perception, condition(one), metric(one, "impact_mps"), metric(one, "delta_v_mps")),
                f"episodes/{one.key}.npz",
            ),
        )
        for one in sorted(crashed, key=lambda one: -metric(one, "delta_v_mps"))[:_WORST]
    )
    note = f"{len(failed)} episodes failed, first: {failed[0].outcome}: {failed[0].message}" if failed else ""
    return Table("hardest", NAMES["hardest"], "scenario", tuple(columns), rows, note)


def _controls(result: CampaignResult) -> Table:
    fine = sum(one.outcome == Outcome.ARRIVED.value for one in result.controls)
    note = f"{fine} of {len(result.controls)} arrived with the truth." if result.controls else ""
    return Table("controls", NAMES["controls"], "", (), (), note)
