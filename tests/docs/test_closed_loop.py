"""Closed loop: what the report of studies/closed_loop says is in the committed campaigns."""

import re
from collections import Counter
from pathlib import Path

import msgspec

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.plan import episodes_of
from dsrc.closed_loop.campaign.run import CampaignResult
from dsrc.closed_loop.metrics.comparison import Value, arrived, avoidable, collided, counted, pairs
from dsrc.closed_loop.metrics.statistics import paired_rates
from dsrc.closed_loop.report.report import markdown, sections
from dsrc.closed_loop.report.tables import parts_of
from dsrc.closed_loop.types import Outcome
from studies.closed_loop.page import PAGE, committed


def campaigns() -> dict[str, CampaignResult]:
    """Committed campaigns with the results of theirs that are committed, by the name of their folder."""
    found = (committed(path) for path in sorted(PAGE.parent.glob("*.toml")))
    return {folder.name: result for folder, result in found}


def test_the_tables_of_the_closed_loop_are_those_of_its_campaigns() -> None:
    page = PAGE.read_text(encoding="utf-8")
    blocks = {
        f"{folder}/{section.name}": section.markdown(Path("report") / folder)
        for folder, result in campaigns().items()
        for section in sections(result)
    }
    places = re.findall(r"<!-- begin (\S+/\S+) -->\n(.*?)\n<!-- end \1 -->", page, re.DOTALL)
    published = {
        "which-corruption-kills",
        "taught-with-corruption",
        "range-around-the-ego",
        "nothing-is-hidden",
        "background-traffic",
        "pedestrians-and-bicycles",
    }
    assert {name.partition("/")[0] for name, _ in places} == published
    assert all(shown == blocks[name] for name, shown in places)
    for folder in published:
        result = campaigns()[folder]
        assert (PAGE.with_suffix("") / folder / "report.md").read_text(encoding="utf-8") == markdown(result)
        shipped = tuple(msgspec.structs.replace(one, checkpoint="") for one in result.plan.perceptions)
        jobs = episodes_of(msgspec.structs.replace(result.plan, perceptions=shipped))
        planned = {(job.scenario, job.seed, job.perception, job.condition.kind) for job in jobs}
        assert {(one.scenario, one.seed, one.perception, one.corruption) for one in result.results} == planned


def test_what_is_said_of_training_with_corruption_is_in_its_results() -> None:
    page = PAGE.read_text(encoding="utf-8")
    text = " ".join(page.partition("## Taught with corruption")[2].partition("<!-- begin")[0].split())
    common = parts_of(campaigns()["taught-with-corruption"])[0]

    def of(name: str, corruption: str) -> list[EpisodeResult]:
        return [one for one in common if (one.perception, one.corruption) == (name, corruption)]

    def told(value: Value, name: str, corruption: str) -> tuple[int, int]:
        met = [value(one) for one in of(name, corruption) if one.outcome != Outcome.DESYNCHRONISED.value]
        return round(sum(met)), len(met)

    new, old = "DSRC, corrupted clouds", "DSRC"
    (crashed, met), (before, _) = (told(collided, name, "snow") for name in (new, old))
    assert f"crashes in {crashed} of {met} encounters where DSRC does in {before};" in text
    assert told(collided, new, "clean") == told(collided, old, "clean") == (1, 43) and "both crash in 1 of 43." in text
    where = Counter(one.scenario for one in of(new, "snow") if collided(one))
    assert where == {"eebl_chain": 5, "stalled_after_curve": 5, "roundabout_entry": 3} and "Ten of the 13 are" in text
    (more, ours), (fewer, theirs) = (told(arrived, name, "fog") for name in (new, old))
    assert f"{more} of {ours} arrive instead of {fewer} of {theirs}" in text
    for corruption, words in (("snow", (1, 5)), ("fog", (5, 1))):
        matched = pairs(of(new, corruption), of(old, corruption))
        found = paired_rates(*([arrived(pair[side]) for pair in matched] for side in (0, 1)))
        assert (found.only_first, found.only_second) == words and found.p_value > 0.05


def test_what_is_said_of_pedestrians_and_bicycles_is_in_their_results() -> None:
    page = PAGE.read_text(encoding="utf-8")
    text = " ".join(page.partition("## Pedestrians and bicycles")[2].partition("## Whose crash")[0].split())
    result = campaigns()["pedestrians-and-bicycles"]
    kinds = {one.corruption for one in result.results} - {"clean"}
    names = ("DSRC", "plain student", "ego alone", "late fusion")

    def of(name: str, *corruptions: str) -> list[EpisodeResult]:
        chosen = corruptions or ("clean",)
        return [one for one in result.results if one.perception == name and one.corruption in chosen]

    def compared(ours: list[EpisodeResult], theirs: list[EpisodeResult], value: Value) -> tuple[int, int, float]:
        matched = pairs(ours, theirs)
        clusters = [(one.scenario, one.seed) for one, _ in matched]
        found = paired_rates(*([value(pair[side]) for pair in matched] for side in (0, 1)), clusters=clusters)
        return round(found.only_first), round(found.only_second), found.p_value

    def of_clean(name: str, corruption: str, value: Value) -> tuple[int, int, float]:
        as_clean = [msgspec.structs.replace(one, corruption="clean", severity=0) for one in of(name, corruption)]
        return compared(as_clean, of(name), value)

    def told(value: Value, name: str, *corruptions: str) -> str:
        met = counted(of(name, *corruptions))
        return f"{round(sum(map(value, met)))} of {len(met)}"

    crashed = [round(sum(map(collided, of(name)))) for name in names]
    assert crashed[0] == crashed[1] and crashed[3] == 0
    assert f"crash in {crashed[0]} of 60 episodes each, the ego alone in {crashed[2]};" in text
    first, second, p_value = compared(of("DSRC"), of("ego alone"), arrived)
    assert f"{first} arrive with DSRC only and none with the ego only (p < 0.001)" in text
    assert second == 0 and p_value < 0.001
    alone = told(collided, "ego alone", *kinds)
    assert f"DSRC crashes in {told(collided, 'DSRC', *kinds)}, the ego alone in {alone}; " in text
    first, second, p_value = compared(of("DSRC", *kinds), of("ego alone", *kinds), arrived)
    snow = compared(of("DSRC", "snow"), of("ego alone", "snow"), arrived)
    assert f"{first} pairs arrive with DSRC only, {second} with the ego only (p < 0.001), {snow[1]} of them" in text
    assert p_value < 0.001 and snow[2] > 0.05

    assert f"DSRC arrives in {told(arrived, 'DSRC', 'snow')} episodes, all of which it finishes clean" in text
    assert f"(p = {of_clean('DSRC', 'snow', arrived)[2]:.3f})" in text
    assert f"plain student in {told(arrived, 'plain student', 'snow')} (p < 0.001)" in text
    assert of_clean("plain student", "snow", arrived)[2] < 0.001
    assert told(collided, "DSRC", "snow") == told(collided, "plain student", "snow") == "4 of 30"
    harm = [of_clean(name, "snow", collided)[2] for name in names[:2]]
    assert harm == [0.125, 0.125] and "Both crash in 4 of 30, which is not resolved against none" in text

    ours = told(arrived, "DSRC", "crosstalk").replace(" of ", " of the ")
    assert f"DSRC arrives in {ours} episodes that met" in text
    assert f"(p = {of_clean('DSRC', 'crosstalk', arrived)[2]:.3f} against" in text
    plain, late, ego = (told(arrived, name, "crosstalk") for name in ("plain student", "late fusion", "ego alone"))
    assert f"the plain student in {plain} and late fusion in {late} (p < 0.001 each), the ego alone in {ego}." in text
    assert all(of_clean(name, "crosstalk", arrived)[2] < 0.001 for name in ("plain student", "late fusion"))
    lost = Counter(one.outcome for one in of("DSRC", "crosstalk"))["desynchronised"]
    assert f"{lost} of DSRC's 30 so long" in text

    mild = ("fog", "beam_missing", "motion_blur", "cross_sensor")
    met = counted(of("DSRC", *mild))
    assert not any(map(collided, met)) and [one.corruption for one in met if not arrived(one)] == ["fog"]
    assert f"arrives in fog in {told(arrived, 'ego alone', 'fog')}." in text
    both = of("DSRC", *kinds), of("plain student", *kinds)
    first, second, p_value = compared(*both, arrived)
    assert f"in {first} pairs against {second} of {len(pairs(*both))} (p = {p_value:.3f})" in text
    assert min(compared(of("DSRC", k), of("plain student", k), arrived)[2] for k in kinds) > 0.05
    stuck = [one for one in of("late fusion") if one.scenario == "cyclist_right_hook"]
    assert f"{Counter(one.outcome for one in stuck)['stuck']} of 20 are stuck" in text
    assert told(collided, "late fusion", *kinds).startswith("0 ")
    assert f"arrives in {told(arrived, 'late fusion', *kinds)} corrupted episodes" in text
    assert {one.outcome for one in result.controls} == {"arrived"} and f"All {len(result.controls)} controls" in text


def test_what_the_closed_loop_s_page_says_is_in_its_results() -> None:
    text = " ".join(PAGE.read_text(encoding="utf-8").split())
    result = campaigns()["which-corruption-kills"]
    common = parts_of(result)[0]
    kinds = {one.corruption for one in common} - {"clean"}

    def of(name: str, *corruptions: str) -> list[EpisodeResult]:
        return [one for one in common if one.perception == name and one.corruption in corruptions]

    def compared(ours: list[EpisodeResult], theirs: list[EpisodeResult], value: Value) -> tuple[int, int, str]:
        matched = pairs(ours, theirs)
        clusters = [(one.scenario, one.seed) for one, _ in matched]
        found = paired_rates(*([value(pair[side]) for pair in matched] for side in (0, 1)), clusters=clusters)
        p_value = f"p = {found.p_value:.3f}" if found.p_value >= 0.001 else "p < 0.001"
        return round(found.only_first), round(found.only_second), p_value

    def as_clean(results: list[EpisodeResult]) -> list[EpisodeResult]:
        return [msgspec.structs.replace(one, corruption="clean", severity=0) for one in results]

    met = [sum(collided(one) for one in of(name, "clean")) for name in ("DSRC", "ego alone", "plain student")]
    assert f"DSRC crashes in {met[0]:.0f} of 171 encounters, 4 %, and the ego alone in {met[1]:.0f}, 68 %" in text
    assert f"clean ({met[0]:.0f} and {met[2]:.0f} of 171" in text and len(of("DSRC", "clean")) == 171
    assert compared(of("DSRC", "clean"), of("ego alone", "clean"), collided)[0] == 0
    words = ["no", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine"]
    more, fewer, p_value = compared(of("DSRC", *kinds), of("ego alone", *kinds), arrived)
    lost = f"in which the ego alone does not, and the other way round in {words[fewer]} ({p_value})"
    assert f"DSRC arrives in {more} pairs {lost}" in text
    more, fewer, p_value = compared(of("DSRC", *kinds), of("plain student", *kinds), arrived)
    matched = len(pairs(of("DSRC", *kinds), of("plain student", *kinds)))
    assert f"in {more} pairs against {fewer} of {matched} ({p_value})" in text
    more, fewer, p_value = compared(of("DSRC", "fog"), of("plain student", "fog"), arrived)
    assert f"in fog in {more} against {fewer} ({p_value})" in text
    for name, claim in (("DSRC", "in one of the same clean ({})"), ("plain student", "instead of two ({})")):
        assert claim.format(compared(as_clean(of(name, "snow")), of(name, "clean"), collided)[2]) in text
        foggy = as_clean([one for one in of(name, "fog") if one.outcome != Outcome.DESYNCHRONISED.value])
        _, stopped, p_value = compared(foggy, of(name, "clean"), arrived)
        here = sum(arrived(one) for one in foggy)
        assert f"in {here:.0f} of {len(foggy)} instead of {here + stopped:.0f} ({p_value})" in text
    worse, better, p_value = compared(
        as_clean(of("plain student", "cross_sensor")), of("plain student", "clean"), collided
    )
    assert f"the plain student {words[worse]} crashes and spares {words[better]} ({p_value})" in text
    worse, better, p_value = compared(as_clean(of("DSRC", "cross_sensor")), of("DSRC", "clean"), collided)
    assert better == 0 and f"DSRC's {words[worse]} are not resolved ({p_value})" in text
    for conditions, claim in ((["clean"], "(6 and 10 of 171, {})"), (kinds, "(30 of 512 and 39 of 509, {})")):
        ours, theirs = of("DSRC", *conditions), of("plain student", *conditions)
        assert claim.format(compared(ours, theirs, collided)[2]) in text
        counts = [round(sum(map(collided, results))) for results in (ours, theirs)]
        assert counts == ([6, 10] if conditions == ["clean"] else [30, 39])
    ours, theirs, p_value = compared(of("late fusion", "snow"), of("DSRC", "snow"), collided)
    assert f"in {ours} pairs late fusion only, in {theirs} DSRC only ({p_value})" in text
    snow = Counter(one.scenario for one in of("DSRC", "snow") if collided(one))
    assert snow == {"stalled_after_curve": 10, "eebl_chain": 6, "lta_truck": 2}
    assert "Sixteen of DSRC's 18 crashes in snow are on fast roads, ten of them in `stalled_after_curve`" in text
    elsewhere = [one for one in of("DSRC", "clean", *(kinds - {"snow"})) if collided(one)]
    chain = [one for one in elsewhere if one.scenario == "eebl_chain"]
    assert f"DSRC's {len(elsewhere)} crashes without snow {len(chain)} are in `eebl_chain`" in text
    spared = avoidable(common, result.careful)
    assert len(spared) - sum(spared) == 2 and all(avoidable(of("DSRC", "clean", *kinds), result.careful))
    assert {one.outcome for one in result.controls} == {"arrived"} and f"All {len(result.controls)} controls" in text
