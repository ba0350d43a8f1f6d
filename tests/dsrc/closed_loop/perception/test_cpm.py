"""ETSI's messages in the loop: fewer bytes than all boxes, and about what they tell."""

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from dsrc.closed_loop.loop import ClosedLoop, LoopSettings
from dsrc.closed_loop.perception.cpm import CpmPerception
from dsrc.closed_loop.perception.detector import DetectorPerception
from dsrc.closed_loop.perception.open import open_perception
from dsrc.closed_loop.types import Percept
from dsrc.messages.message import near_any
from sim.errors import SettingsError
from tests.dsrc.evaluation.fakes import PointCounter

TICKS = 9
"""Instants of the episode that are perceived, 0.1 s apart."""


@pytest.fixture(scope="module")
def loop() -> ClosedLoop:
    driven = ClosedLoop("lta_truck", open_perception("truth"), settings=LoopSettings(duration_s=2.5))
    driven.run(1)
    return driven


def percepts(loop: ClosedLoop, text: str, channel: str, ticks: int = TICKS) -> list[Percept]:
    eyes: Any = open_perception(text, channel=channel)
    assert isinstance(eyes, DetectorPerception)
    eyes.reset(loop.scenario, loop.ego_id, 1)
    actors = [tick.actors for tick in loop.ticks[-ticks:]]
    return [eyes.perceive(before, now, {}) for before, now in pairwise(actors)]


def test_messages_are_smaller_than_those_of_all_boxes_and_tell_of_the_same_objects(loop: ClosedLoop) -> None:
    told, late = percepts(loop, "cpm", "its-g5-6"), percepts(loop, "late", "its-g5-6")
    sent, usual = (sum(link.bytes_now for one in found for link in one.links) for found in (told, late))
    assert 0 < sent < 0.7 * usual
    last, boxes = told[-1], late[-1]
    assert near_any(boxes.boxes, last.boxes).mean() > 0.7
    assert np.isnan(last.velocity).all() and (last.boxes.object_id == -1).all()


@pytest.mark.slow
def test_senders_that_leave_out_what_others_tell_send_less_and_the_ego_knows_of_as_many(loop: ClosedLoop) -> None:
    usual, less = percepts(loop, "cpm", "ideal"), percepts(loop, "cpm-dynamics", "ideal")
    sent = [sum(link.bytes_now for one in found for link in one.links) for found in (usual, less)]
    assert 0 < sent[1] < sent[0]
    assert near_any(usual[-1].boxes, less[-1].boxes).mean() > 0.8


def test_an_instant_without_a_message_is_not_one_that_was_received(loop: ClosedLoop) -> None:
    links = [link for found in percepts(loop, "cpm", "ideal") for link in found.links]
    silent = [link for link in links if link.bytes_now == 0]
    assert silent and all(link.age_s > 0.0 for link in silent if link.received)
    assert {link.age_s for link in links if link.bytes_now} == {0.0}


def test_without_a_message_the_ego_is_alone_and_two_runs_are_the_same(loop: ClosedLoop) -> None:
    silent, alone = (percepts(loop, *how, ticks=4) for how in (("cpm", "ideal,loss=1"), ("ego", "ideal")))
    assert [len(one.boxes) for one in silent] == [len(one.boxes) for one in alone]
    first, second = (percepts(loop, "cpm", "paper", ticks=4) for _ in range(2))
    assert [one.boxes.array.tobytes() for one in first] == [one.boxes.array.tobytes() for one in second]


def test_what_cannot_tell_boxes_is_refused(loop: ClosedLoop) -> None:
    with pytest.raises(SettingsError, match="agents that tell boxes, as those of late fusion do, found one that fuses"):
        CpmPerception(PointCounter()).reset(loop.scenario, loop.ego_id, 0)
    with pytest.raises(SettingsError, match=r"fault 'ghost:1': .*not ETSI's in episodes"):
        open_perception("cpm", fault="ghost")
