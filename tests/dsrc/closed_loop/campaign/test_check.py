"""What is wrong in a campaign, or would act on nothing, is told before anything is driven."""

from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from dsrc.closed_loop.campaign.jobs import episodes_of
from dsrc.closed_loop.campaign.read import campaign_of, read_campaign
from dsrc.closed_loop.ego import choose_ego
from dsrc.closed_loop.encounter import encounter_agents
from dsrc.options.driving import DriveOptions
from sensors.recording.agent_selection import nearest_agents
from sensors.recording.encounter_check import with_proven_encounter
from sim.catalog.load import load_scenario
from sim.errors import SettingsError, UserError
from sim.world.standing import open_standing


@pytest.mark.parametrize(
    ("text", "field"),
    [
        ('scenarios = ["nowhere"]', "nowhere"),
        ('corruption = ["mist"]', "mist"),
        ("seeds = 0", "seeds"),
        ('channel = ["pigeon"]', "pigeon"),
        ('driver = "reckless"', "driver: name: expected planning, anticipating, evading, careful, module:Class"),
        ("colour = 1", "colour"),
        ("clean_seeds = [1, 1]", "clean_seeds"),
        ('corruption = ["fog", "fog"]', "corruption"),
        ('[[perceptions]]\nname = "a|b"\nuses = "truth"', "perceptions.name"),
        ('[[perceptions]]\nname = ""\nuses = "truth"', "perceptions.name"),
    ],
)
def test_a_wrong_plan_is_one_line_that_names_the_field(tmp_path: Path, text: str, field: str) -> None:
    path = tmp_path / "plan.toml"
    lines = ['scenarios = ["ima_building"]'] * (not text.startswith("scenarios"))
    path.write_text("\n".join([*lines, text, '[[perceptions]]\nname = "truth"\n']), encoding="utf-8")
    with pytest.raises(UserError) as error:
        read_campaign(path)
    assert field in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("text", ["severity = [4]", 'family = "paper"', 'corrupted_agents = "helpers"'])
def test_settings_of_corruptions_beside_none_are_refused(tmp_path: Path, text: str) -> None:
    path, lines = tmp_path / "plan.toml", f'scenarios = ["ima_building"]\n{text}\n[[perceptions]]\nname = "ego"\n'
    path.write_text(f'corruption = ["clean"]\n{lines}', encoding="utf-8")
    with pytest.raises(SettingsError, match=rf"plan\.toml: {text.split()[0]}: expected none, since"):
        read_campaign(path)
    path.write_text(f'corruption = ["fog"]\n{lines}', encoding="utf-8")
    assert len(read_campaign(path).conditions) == 2


@pytest.mark.parametrize("text", ['corruption = ["clean"]', 'corruption = ["fog"]'])
def test_seeds_that_no_episode_would_have_are_refused(tmp_path: Path, text: str) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(
        f'scenarios = ["ima_building"]\n{text}\nseeds = [20, 21]\n[[perceptions]]\nname = "truth"\n', encoding="utf-8"
    )
    with pytest.raises(SettingsError, match=r"plan\.toml: seeds: expected none, since"):
        read_campaign(path)
    with path.open("a", encoding="utf-8") as file:
        file.write('[[perceptions]]\nname = "ego"\n')
    if "fog" in text:
        assert {job.seed for job in episodes_of(read_campaign(path)) if job.condition.kind == "fog"} == {20, 21}


@pytest.mark.parametrize(
    ("perception", "text"),
    [
        ("truth", 'corruption = ["fog"]'),
        ("sight", 'engine = "bf16"'),
        ("truth", 'channel = ["paper"]'),
        ("ego", 'channel = ["ideal", "paper"]'),
    ],
)
def test_settings_of_what_no_perception_has_are_refused(tmp_path: Path, perception: str, text: str) -> None:
    path = tmp_path / "plan.toml"
    lines = f'scenarios = ["ima_building"]\n{text}\n[[perceptions]]\nname = "{perception}"\n'
    path.write_text(lines, encoding="utf-8")
    with pytest.raises(SettingsError, match=rf"plan\.toml: {text.split()[0]}: expected none, since no perception has"):
        read_campaign(path)
    path.write_text(f'{lines}[[perceptions]]\nname = "team"\n', encoding="utf-8")
    assert len(read_campaign(path).perceptions) == 2


@pytest.mark.parametrize("given", [{"channel": ("paper",)}, {"engine": "bf16"}])
def test_options_of_what_the_perception_has_not_are_refused(given: dict[str, Any]) -> None:
    perception = "ego" if "channel" in given else "truth"
    with pytest.raises(SettingsError, match=f"drive: {next(iter(given))}: expected"):
        campaign_of(DriveOptions(what="ima_building", perception=(perception,), **given))


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fault": ("fgo:3",)}, "drive: fault 'fgo:3': expected a kind of fault, found fgo; did you mean 'fog'"),
        ({"fault": ("fog:3 from 0 s", "fog:3")}, "drive: fault: expected texts that differ, found fog:3"),
        ({"fault": ("fog:3",), "corruption": ("fog",)}, "fault: expected a fault that no corruption, channel or other"),
        (
            {"fault": ("loss:1 from 1 s",), "perception": ("ego", "sight")},
            "expected a perception that 'loss:1 from 1 s' acts on, such as team, found ego, sight",
        ),
        (
            {"fault": ("fog from 1 s + noise from 20 s",)},
            "^drive: fault 'noise from 20 s': expected a begin before the end of .* episode, 20 s, found 20 s$",
        ),
    ],
)
def test_a_fault_that_is_wrong_or_there_already_is_told(options: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        campaign_of(DriveOptions(**{"what": "ima_building", "perception": ("team",), **options}))


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"fault": ("fog:3 on 4711",)}, "fault 'fog:3 on 4711'"),
        ({"fault": ("fog:3 on 1003 + loss:1 from 2 s on 1002,4711",)}, "fault 'loss:1 from 2 s on 1002,4711'"),
        ({"corruption": ("fog",), "corrupted_agents": "-1,4711"}, "corrupted_agents"),
    ],
)
def test_an_agent_that_no_encounter_of_a_plan_has_is_told_before_driving(options: dict[str, Any], field: str) -> None:
    asked = DriveOptions(what="lta_truck", perception=("team",), seed=(0, 1), **options)
    message = f"^drive: {field}: expected ids among the agents 1000, 1002, 1003, -1, found 4711$"
    with pytest.raises(SettingsError, match=message):
        campaign_of(asked)
    campaign_of(replace(asked, what="four_way"))  # whose vehicles are known when it is driven


def test_the_agents_of_an_encounter_are_those_of_its_episodes() -> None:
    for name in ("lta_truck", "stalled_after_curve:no_conflict"):
        scenario = with_proven_encounter(load_scenario(name), 1)
        with open_standing(scenario, 1) as traffic:
            carriers = nearest_agents(traffic.actors, scenario, choose_ego(traffic, scenario))
        units = [-1 - row for row in range(len(scenario.agents.roadside))]
        assert list(encounter_agents(scenario, 1)) == [*carriers, *units]


def test_a_fault_may_begin_as_late_as_the_driver_s_longest_episode(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    text = 'scenarios = ["ima_building"]\nfault = ["fog from 25 s"]\n[[perceptions]]\nname = "team"\n'
    path.write_text(f'driver = "anticipating"\n{text}')
    assert read_campaign(path).loop.duration_s == 30.0
    path.write_text(text)
    with pytest.raises(SettingsError, match=r"plan.toml: fault 'fog from 25 s': .* longest episode, 20 s, found 25 s"):
        read_campaign(path)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"defence": ("moton",)}, "drive: defence: expected none, or one of .* found moton; did you mean 'm"),
        ({"defence": ("trust",)}, "drive: defence: expected another one beside trust"),
        ({"defence": ("motion,trust", "trust,motion")}, "defence: expected texts that differ, found motion,trust"),
        (
            {"defence": ("motion",), "perception": ("team", "truth")},
            "^drive: defence 'motion': .* whose helpers tell boxes, team-sight or late .*, found team",
        ),
        (
            {"fault": ("ghost",), "perception": ("ego",)},
            "fault 'ghost:1': expected a perception with helpers, such as team, late or team-sight .*, found ego",
        ),
        (
            {"fault": ("replay:1",), "perception": ("team",)},
            "a perception whose helpers tell boxes, team-sight or late .*, found team",
        ),
        (
            {"fault": ("ghost on ego",)},
            "expected helpers, vehicles, roadside or ids after 'on', found ego",
        ),
    ],
)
def test_a_wrong_defence_or_attack_is_told_in_one_line(options: dict[str, Any], message: str) -> None:
    with pytest.raises(SettingsError, match=message) as error:
        campaign_of(DriveOptions(**{"what": "ima_building", "perception": ("team-sight",), **options}))
    assert "\n" not in str(error.value)
