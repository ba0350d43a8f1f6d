"""Campaigns from a TOML and from a command line."""

from pathlib import Path

import pytest
from msgspec.structs import replace

from dsrc.closed_loop.campaign.jobs import episodes_of
from dsrc.closed_loop.campaign.plan import PerceptionSpec
from dsrc.closed_loop.campaign.read import campaign_of, is_campaign, read_campaign
from dsrc.faults.fault import faults_text
from dsrc.options.driving import DriveOptions
from sim.errors import SettingsError


def test_a_file_in_a_plan_is_the_checkpoint(tmp_path: Path) -> None:
    (tmp_path / "one.pt").write_bytes(b"weights")
    plan = tmp_path / "plan.toml"
    head = 'scenarios = ["ima_building"]\n[[perceptions]]\nname = "mine"\n'
    plan.write_text(f'{head}uses = "late=one.pt"\n')
    (mine,) = read_campaign(plan).perceptions
    assert mine == PerceptionSpec(name="mine", uses="late", checkpoint=str(tmp_path / "one.pt"))
    plan.write_text(f'{head}uses = "one.pt"\ncheckpoint = "two.pt"\n')
    with pytest.raises(
        SettingsError, match=r"'one.pt' names a detector file already; leave out perceptions.mine.checkpoint"
    ):
        read_campaign(plan)


@pytest.mark.parametrize("text", ["truth", "a.pt", "my_eyes:Own"])
def test_a_checkpoint_that_nobody_takes_is_refused(tmp_path: Path, text: str) -> None:
    with pytest.raises(SettingsError, match=r"; leave out --checkpoint"):
        campaign_of(DriveOptions(what="ima_building", perception=(text,), checkpoint=tmp_path / "a.pt"))


def test_episodes_leave_room_for_a_driver_that_may_be_late_unless_the_plan_says_how_long(tmp_path: Path) -> None:
    def seconds(text: str) -> float:
        path = tmp_path / "plan.toml"
        path.write_text(f'scenarios = ["ima_building"]\n{text}\n[[perceptions]]\nname = "truth"\n')
        return read_campaign(path).loop.duration_s

    asked = DriveOptions(what="ima_building", driver="anticipating")
    assert seconds("") == campaign_of(DriveOptions(what="ima_building")).loop.duration_s == 20.0
    assert seconds('driver = "anticipating"') == campaign_of(asked).loop.duration_s == 30.0
    assert seconds('driver = "anticipating"\nloop = { duration_s = 12.0 }') == 12.0
    assert campaign_of(replace(asked, duration_s=12.0)).loop.duration_s == 12.0


def test_repeated_seeds_of_a_command_line_are_refused() -> None:
    with pytest.raises(SettingsError, match="drive: seed: expected numbers that differ, found 4"):
        campaign_of(DriveOptions(what="ima_building", seed=(4, 4)))


def test_options_beside_a_plan_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    path.write_text('scenarios = ["ima_building"]\n[[perceptions]]\nname = "truth"\n', encoding="utf-8")
    assert campaign_of(DriveOptions(what=str(path))).scenarios == ("ima_building",)
    for given, message in (
        ({"seed": (1, 2)}, "seed: .*, found 1 2$"),
        ({"driver": "pipe:a b"}, "driver: .* pipe:a b$"),
    ):
        with pytest.raises(SettingsError, match=f"^drive: {message}"):
            campaign_of(DriveOptions(what=str(path), **given))


@pytest.mark.parametrize("text", ['sceanrios = ["lta_truck"]', 'perception = ["ego"]', "seeds = 3"])
def test_a_campaign_with_a_mistake_is_answered_as_one(tmp_path: Path, text: str) -> None:
    """A scenario has none of a campaign's own keys."""
    path = tmp_path / "c.toml"
    path.write_text(f"{text}\n")
    assert is_campaign(path)
    with pytest.raises(SettingsError, match=r"c\.toml"):
        read_campaign(path)


@pytest.mark.parametrize("text", ["duration_s = 1.0", "seed = 3"])
def test_a_scenario_is_no_campaign_however_its_keys_are_called(tmp_path: Path, text: str) -> None:
    (tmp_path / "scenario.toml").write_text(f"{text}\n")
    assert not is_campaign(tmp_path / "scenario.toml")


def test_a_plan_says_faults_in_the_same_words(tmp_path: Path) -> None:
    path = tmp_path / "plan.toml"
    text = (
        'scenarios = ["ima_building"]\nfault = ["fog:3 from 4 s on helpers", "loss:0.3"]\nclean_seeds = 2\nseeds = 1\n'
    )
    path.write_text(text + 'corruption = ["clean"]\n[[perceptions]]\nname = "team"\n')
    jobs = episodes_of(read_campaign(path))
    assert [(job.seed, faults_text(job.faults), job.channel) for job in jobs] == [
        (0, "", "ideal"),
        (0, "fog:3 from 4 s on helpers", "ideal"),
        (0, "", "ideal,loss=0.3"),
        (1, "", "ideal"),
    ]
    path.write_text(text.replace("fog:3", "fog:7") + '[[perceptions]]\nname = "team"\n')
    with pytest.raises(
        SettingsError, match=r"plan.toml: fault 'fog:7 from 4 s on helpers', severity: expected a whole number, 1 to 5"
    ):
        read_campaign(path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("clean_seeds = 100000000000", "clean_seeds: expected int <= 1000000, found 100000000000"),
        (f"seeds = [{2**63}]", r"seeds\[0\]: expected"),
        ("[loop]\nduration_s = -1", "loop: duration_s: expected seconds > 0, found -1"),
    ],
)
def test_a_wrong_number_of_a_plan_is_told_with_the_file(tmp_path: Path, text: str, message: str) -> None:
    path = tmp_path / "plan.toml"
    path.write_text(f'scenarios = ["ima_building"]\n{text}\n[[perceptions]]\nname = "truth"\n')
    with pytest.raises(SettingsError, match=rf"plan\.toml: {message}"):
        read_campaign(path)
