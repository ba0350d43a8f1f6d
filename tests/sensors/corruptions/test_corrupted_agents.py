"""Who is corrupted: all agents, the ego, its helpers, or some by their ids."""

import numpy as np
import pytest

from sensors.corruptions import CORRUPTIONS, CorruptedAgents, corrupt_frame, parse_agents
from sim.errors import DataError, SettingsError
from tests.sensors.corruptions.drives import street_drive
from tests.sensors.corruptions.frames import AGENTS, frame
from tests.sensors.corruptions.street import same

SPARING = tuple(kind for kind in CORRUPTIONS if CORRUPTIONS[kind].spares_ego)


def changed(kind: str, who: CorruptedAgents, ego_id: int | None = None) -> set[int]:
    """Ids of the agents whose sweep or reported pose is not that of the recording."""
    clean = frame(5)
    out = corrupt_frame(clean, kind, 5, 4, ego_id=ego_id, corrupted_agents=who)
    return {
        before.agent_id
        for before, after in zip(clean.agents, out.agents, strict=True)
        if not same(before.sweep, after.sweep)
        or not np.array_equal(before.sweep.world_from_lidar, after.sweep.world_from_lidar)
    }


@pytest.mark.parametrize("kind", ["beam_missing", "crosstalk", "fog", "motion_blur"])
def test_only_the_agents_asked_for_are_corrupted(kind: str) -> None:
    assert changed(kind, "all") == set(AGENTS)
    assert changed(kind, "ego") == {1000}
    assert changed(kind, "ego", ego_id=1003) == {1003}
    assert changed(kind, "helpers") == {1003, -1}
    assert changed(kind, "helpers", ego_id=1003) == {1000, -1}
    assert changed(kind, "vehicles") == {1000, 1003}
    assert changed(kind, "roadside") == {-1}
    assert changed(kind, (1003,)) == {1003}
    assert changed(kind, (1000, -1)) == {1000, -1}


@pytest.mark.parametrize("kind", list(CORRUPTIONS))
def test_a_corrupted_sweep_is_the_same_whoever_else_is_corrupted(kind: str) -> None:
    clean = street_drive(2)[1]
    ids = [agent.agent_id for agent in clean.agents]
    together = corrupt_frame(clean, kind, 4, 9)
    for one in ids:
        alone = corrupt_frame(clean, kind, 4, 9, corrupted_agents=(one,))
        assert same(alone.agent(one).sweep, together.agent(one).sweep)
        assert all(alone.agent(other).sweep is clean.agent(other).sweep for other in ids if other != one)


@pytest.mark.parametrize("kind", SPARING)
def test_an_error_relative_to_the_ego_is_one_of_helpers_alone(kind: str) -> None:
    assert changed(kind, "helpers") == changed(kind, "all") >= {1003}
    assert 1000 not in changed(kind, "all")
    with pytest.raises(SettingsError, match=f"corruption '{kind}': corrupted_agents: expected helpers, .*, found ego"):
        changed(kind, "ego")


@pytest.mark.parametrize("who", ["", "Ego", "1003", ()])
def test_other_words_are_refused(who: CorruptedAgents) -> None:
    with pytest.raises(SettingsError, match=r"corrupted_agents: expected all, .*, roadside or ids of agents, found"):
        changed("fog", who)


def test_an_id_that_is_no_agent_is_refused() -> None:
    message = r"frame 5: corrupted_agents: expected ids among the agents \[1000, 1003, -1\], found 1004"
    with pytest.raises(DataError, match=message):
        changed("fog", (1000, 1004))


def test_text_of_a_command_names_agents_by_word_or_ids() -> None:
    assert [parse_agents(text) for text in ("all", "ego", "helpers")] == ["all", "ego", "helpers"]
    assert parse_agents("1003,-1") == (1003, -1)
    with pytest.raises(SettingsError, match=r"corrupted_agents: expected all, .* such as 1003,-1, found helper"):
        parse_agents("helper")
