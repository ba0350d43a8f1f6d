"""Episodes of a campaign: cells with keys of their own, in their order."""

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from dsrc.closed_loop.campaign.episode import episode_key
from dsrc.closed_loop.campaign.jobs import careful_of, controls_of, episodes_of, late_messages
from dsrc.closed_loop.campaign.plan import PerceptionSpec
from dsrc.closed_loop.campaign.read import campaign_of, read_campaign
from dsrc.closed_loop.loop import LoopSettings
from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.faults.fault import faults_text
from dsrc.options.driving import DriveOptions
from sim.errors import SettingsError
from sim.radio import get_channel
from tests.dsrc.closed_loop.campaign.blind import PLAN
from tests.dsrc.closed_loop.perception.toy import EGO, PLACES, SCENARIO, Knowing, build, instant


def test_every_setting_has_a_cell_of_its_own() -> None:
    plans = [
        PLAN,
        replace(PLAN, loop=LoopSettings(duration_s=15.0, latency_s=0.1)),
        replace(PLAN, driver="careful"),
        replace(PLAN, scenarios=("ima_queue",)),
        replace(PLAN, clean_seeds=(7,), seeds=(7,)),
    ]
    keys = [episode_key(job) for plan in plans for job in episodes_of(plan)]
    assert len(set(keys)) == len(keys)


def test_the_engine_decides_cells_of_networks_alone() -> None:
    sensed = replace(PLAN, perceptions=(PerceptionSpec(name="truth"), PerceptionSpec(name="ego")))
    fused, half = (episodes_of(replace(sensed, engine=engine)) for engine in ("fused", "bf16"))
    changed = [one.uses for one, other in zip(fused, half, strict=True) if episode_key(one) != episode_key(other)]
    assert set(changed) == {"ego"} and len(changed) == 2
    assert campaign_of(DriveOptions(what="ima_building", perception=("ego",), engine="bf16")).engine == "bf16"


def test_keys_and_plans_hold_the_engine_of_this_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = DriveOptions(what="ima_building", perception=("truth", "ego"))
    keys = []
    for half, engine in ((True, "bf16"), (False, "fused")):
        monkeypatch.setattr("dsrc.models.storage.deploy.BFLOAT16", half)
        plan = campaign_of(asked)
        own = episodes_of(replace(plan, engine="auto"))
        assert plan.engine == engine and episodes_of(plan) == own
        assert [job.engine for job in own] == ["fused", engine]
        keys.append([episode_key(job) for job in own])
    assert keys[0][0] == keys[1][0] and keys[0][1] != keys[1][1]


def test_names_and_paths_decide_nothing() -> None:
    renamed = replace(
        PLAN, perceptions=tuple(replace(one, name=f"my {one.name}", uses=one.kind) for one in PLAN.perceptions)
    )
    assert [episode_key(job) for job in episodes_of(renamed)] == [episode_key(job) for job in episodes_of(PLAN)]


def test_a_detector_is_known_by_its_content(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def key(text: str, **options: Any) -> str:
        (job,) = episodes_of(campaign_of(DriveOptions(what="ima_building", perception=(text,), **options)))
        return episode_key(job)

    one, copy = tmp_path / "one.pt", tmp_path / "copy.pt"
    for path in (one, copy):
        path.write_bytes(b"weights")
    first = key(str(one))
    assert first == key(str(copy)) == key(f"mine={copy}") == key("team", checkpoint=one)
    assert len({first, key(f"ego={one}"), key(f"late={one}"), key("team")}) == 4
    one.write_bytes(b"other weights")
    assert key(str(one)) != first
    eyes = tmp_path / "eyes_of_a_file.py"
    monkeypatch.syspath_prepend(str(tmp_path))
    eyes.write_text("class Eyes: ...")
    before = key("eyes_of_a_file:Eyes")
    eyes.write_text("class Eyes: detect = print")
    assert key("eyes_of_a_file:Eyes") != before


def test_a_package_of_ones_own_is_known_by_all_its_modules(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    package = tmp_path / "eyes_of_a_package"
    package.mkdir()
    (package / "__init__.py").write_text("from eyes_of_a_package.lids import Eyes")
    (package / "lids.py").write_text("class Eyes: ...")
    plan = campaign_of(DriveOptions(what="ima_building", perception=("eyes_of_a_package:Eyes",)))
    (before,) = map(episode_key, episodes_of(plan))
    (package / "lids.py").write_text("class Eyes: detect = print")
    (after,) = map(episode_key, episodes_of(plan))
    assert before != after


def test_a_scenario_is_known_by_the_content_of_its_files(tmp_path: Path) -> None:
    text = 'name = "mine"\ndescription = "mine"\n[network]\nfile = "mine.net.xml"\n[agents]\nvehicles = 1\n'
    (tmp_path / "mine.toml").write_text(text)
    (tmp_path / "plan.toml").write_text(
        'scenarios = ["mine.toml"]\nchannel = ["trace:mine.csv,loss=0.3"]\npose_error = 0.5\n'
        '[[perceptions]]\nname = "team"\n'
    )
    (tmp_path / "mine.csv").write_text("time_s,delay_s,loss\n0,0.1,0\n")
    keys = []
    for speed in (13.89, 5.0):
        (tmp_path / "mine.net.xml").write_text(f"<net><!-- {speed} --></net>")
        plan = read_campaign(tmp_path / "plan.toml")  # both lie beside it, and not in the current folder
        assert plan.scenarios == (str(tmp_path / "mine.toml"),)
        assert plan.radios == (f"trace:{tmp_path / 'mine.csv'},loss=0.3,pose_error=0.5",)
        keys.append([episode_key(job) for job in episodes_of(plan)])
    assert not set(keys[0]) & set(keys[1])


def test_corruptions_reach_nobody_without_a_sensor() -> None:
    jobs = episodes_of(replace(PLAN, corruption=("paper_six",), perceptions=PLAN.perceptions[:1], seeds=2))
    assert [job.condition.kind for job in jobs] == ["clean", "clean"]


def test_controls_are_those_of_the_encounters() -> None:
    found = controls_of(replace(PLAN, scenarios=("ima_building", "four_way")))
    assert found is not None and found.scenarios == ("ima_building:no_occluder", "ima_building:no_conflict")
    assert controls_of(replace(PLAN, scenarios=("four_way",))) is None
    later = controls_of(replace(PLAN, corruption=("fog",), seeds=(7, 8)))
    assert later is not None and {job.seed for job in episodes_of(later)} == {0, 1, 7, 8}
    busy = controls_of(replace(PLAN, scenarios=("ima_building:dense", "lta_truck:no_occluder")))
    assert busy is not None and busy.scenarios == ("ima_building:dense:no_occluder", "ima_building:dense:no_conflict")


@pytest.mark.parametrize(
    ("corruptions", "perceptions", "seeds"),
    [
        (("clean",), PLAN.perceptions, {0, 1}),
        (("fog",), PLAN.perceptions, {0, 1, 7, 8}),
        (("fog",), PLAN.perceptions[:1], {0, 1}),  # the truth has no sensor that a corruption could break
    ],
)
def test_the_careful_driver_drives_the_seeds_that_others_drive(
    corruptions: tuple[str, ...], perceptions: tuple[PerceptionSpec, ...], seeds: set[int]
) -> None:
    plan = replace(PLAN, corruption=corruptions, perceptions=perceptions, seeds=(7, 8))
    driven = {(job.perception, job.seed) for job in episodes_of(careful_of(plan))}
    assert driven == {("truth", seed) for seed in seeds}
    assert {job.seed for job in episodes_of(plan)} == seeds


def test_a_line_of_a_plan_may_have_a_driver_of_its_own() -> None:
    eyes = (PerceptionSpec(name="truth"), PerceptionSpec(name="careful", uses="truth", driver="careful"))
    jobs = episodes_of(replace(PLAN, perceptions=eyes))
    assert {(job.perception, job.driver) for job in jobs} == {("truth", "planning"), ("careful", "careful")}
    alone = episodes_of(replace(PLAN, perceptions=eyes[:1]))
    assert {episode_key(job) for job in alone} < {episode_key(job) for job in jobs}


def test_changes_of_the_radio_are_channels_of_their_own() -> None:
    options = DriveOptions(what="four_way", perception=("team",), channel=("ideal", "its-g5-6"), loss=0.3, delay_s=0.2)
    assert campaign_of(options).radios == ("ideal,loss=0.3,delay_s=0.2", "its-g5-6,loss=0.3,delay_s=0.2")
    alone = DriveOptions(what="four_way", perception=("team",), pose_error=0.4)
    assert [job.radio["position_error_m"] for job in episodes_of(campaign_of(alone))] == [0.4]
    with pytest.raises(SettingsError, match=r"^drive: .*loss: expected 0 to 1, found 1\.5"):
        campaign_of(DriveOptions(what="four_way", perception=("team",), loss=1.5))


@pytest.mark.parametrize(("delay_s", "every_s"), [(0.05, 0.1), (0.05, 0.2), (0.15, 0.2), (0.1, 0.2), (0.0, 0.2)])
def test_the_age_of_messages_that_wait_is_told_as_it_is_measured(
    monkeypatch: pytest.MonkeyPatch, delay_s: float, every_s: float
) -> None:
    build(monkeypatch)
    plan = campaign_of(DriveOptions(what="four_way", perception=("team",), delay_s=delay_s, detect_every_s=every_s))
    channel = get_channel(plan.radios[0])
    perception = DetectorPerception(Knowing(PLACES[2:]), channel=channel, interval_s=every_s)
    perception.reset(SCENARIO, EGO, 0)
    for step in range(8):
        act = perception.overhear if step % round(every_s / 0.1) else perception.perceive
        act(instant(step), instant(step + 1), {})
    told = [age_s for *_, age_s in late_messages(plan)] or [delay_s]
    (last,) = perception.perceive(instant(8), instant(9), {}).links
    assert [last.age_s] == pytest.approx(told)


def told(*fault: str, **options: Any) -> list[tuple[str, str, str, str]]:
    """Perception, corruption, channel and faults of the episodes of a command line."""
    asked = DriveOptions(what="ima_building", perception=("truth", "ego", "team"), fault=fault, **options)
    return [
        (job.perception, job.condition.label, job.channel, faults_text(job.faults))
        for job in episodes_of(campaign_of(asked))
    ]


def test_each_text_of_faults_is_a_condition_beside_the_clean_one() -> None:
    text = "fog:3 from 4 s to 9 s on helpers + loss:0.3 from 5 s"
    assert told(text) == [
        ("truth", "clean", "ideal", ""),
        *((eyes, "clean", "ideal", faults) for eyes in ("ego", "team") for faults in ("", text)),
    ]
    assert [each for each in told("loss:1 from 2 s") if each[3]] == [("team", "clean", "ideal", "loss:1 from 2 s")]


def test_a_fault_that_an_option_can_say_is_the_same_episode() -> None:
    def keys(**options: Any) -> list[str]:
        asked = DriveOptions(what="ima_building", perception=("team",), **options)
        return [episode_key(job) for job in episodes_of(campaign_of(asked))]

    assert keys(fault=("loss:0.3 + delay:0.1",))[1:] == keys(loss=0.3, delay_s=0.1)
    assert keys(fault=("fog:4 on helpers",)) == keys(corruption=("fog",), severity=(4,), corrupted_agents="helpers")
    assert (
        keys(fault=("snow:2 + loss:0.3",))[1:]
        == [
            episode_key(job)
            for job in episodes_of(
                campaign_of(
                    DriveOptions(
                        what="ima_building", perception=("team",), corruption=("snow",), severity=(2,), loss=0.3
                    )
                )
            )
        ][1:]
    )
    each = keys(fault=("fog:3 from 1 s", "fog:3 from 2 s", "fog:3 to 2 s", "fog:3 from 1 s on ego", "fog:3 + noise:3"))
    assert len(set(each)) == 6


def defended(perception: tuple[str, ...] = ("truth", "team-sight"), **options: Any) -> list[tuple[str, str, str]]:
    """Perception, faults and defence of the episodes of a command line."""
    jobs = episodes_of(campaign_of(DriveOptions(what="ima_building", perception=perception, **options)))
    return [(job.perception, faults_text(job.faults), ",".join(job.defence)) for job in jobs]


def test_each_defence_is_driven_with_each_attack_where_helpers_tell_boxes() -> None:
    assert defended(fault=("ghost", "latency:0.2"), defence=("none", "trust,motion")) == [
        ("truth", "", ""),
        ("truth", "latency:0.2", ""),
        *(("team-sight", text, name) for text in ("", "ghost:1", "latency:0.2") for name in ("", "motion,trust")),
    ]
    assert defended(("ego", "team", "late"), fault=("ghost", "replay:1")) == [
        ("ego", "", ""),
        ("team", "", ""),
        ("team", "ghost:1", ""),
        ("late", "", ""),
        ("late", "ghost:1", ""),
        ("late", "replay:1", ""),
    ]


def test_a_defence_is_another_episode_and_none_is_the_same_as_without() -> None:
    def keys(**options: Any) -> list[str]:
        asked = DriveOptions(what="ima_building", perception=("team-sight",), **options)
        return [episode_key(job) for job in episodes_of(campaign_of(asked))]

    plain = keys()
    assert keys(defence=("none",)) == plain == keys(fault=("ghost",))[:1]
    assert len({*plain, *keys(defence=("none", "motion", "free-space", "free-space,motion"))}) == 4
    assert keys(defence=("motion,free-space",)) == keys(defence=("free-space, motion",))
