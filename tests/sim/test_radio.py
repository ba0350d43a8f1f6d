"""The radio channel keeps the published tables, its statistics and its promises."""

import math
from collections.abc import Iterator
from dataclasses import replace as changed
from pathlib import Path

import numpy as np
import pytest
from msgspec.structs import replace

from sim.errors import DataError, SettingsError
from sim.radio import (
    CHANGES,
    PRESETS,
    Channel,
    ChannelSpec,
    Obstruction,
    Radio,
    RadioSnapshot,
    airtime_s,
    changed_spec,
    cpm_bytes,
    delivery_probability,
    get_channel,
    lost_tiles,
    message_airtime_s,
    packet_count,
    path_loss_db,
)

SLOW, FAST = PRESETS["its-g5-6"], PRESETS["its-g5-27"]


def at(
    index: int, places: list[tuple[float, float]], size: int = 300, sight: Obstruction = Obstruction.FREE
) -> RadioSnapshot:
    count = len(places)
    antenna = np.array([(x, y, 1.6) for x, y in places])
    return RadioSnapshot(
        index, tuple(range(count)), antenna, (size,) * count, np.full((count, count), int(sight), np.int8)
    )


@pytest.mark.parametrize(
    ("spec", "sight", "row"),
    [
        (SLOW, Obstruction.FREE, [1, 1, 1, 1, 1, 1, 1, 1]),
        (SLOW, Obstruction.VEHICLE, [1, 1, 0.999, 0.997, 0.99, 0.97, 0.90, 0.72]),
        (SLOW, Obstruction.BUILDING, [1, 0.97, 0.79, 0.36, 0.05, 0, 0, 0]),
        (FAST, Obstruction.FREE, [1, 1, 1, 0.99, 0.90, 0.72, 0.35, 0.05]),
        (FAST, Obstruction.VEHICLE, [0.93, 0.70, 0.53, 0.34, 0.17, 0.09, 0.03, 0]),
        (FAST, Obstruction.BUILDING, [0.46, 0.01, 0, 0, 0, 0, 0, 0]),
    ],
)
def test_delivery_keeps_the_table(spec: ChannelSpec, sight: Obstruction, row: list[int] | list[float]) -> None:
    """The table of `closed_loop.md` 5, 25 to 500 m at 23 dBm."""
    found = [delivery_probability(spec, d, sight) for d in (25, 50, 70, 100, 150, 200, 300, 500)]
    np.testing.assert_allclose(found, row, atol=0.006)


def test_airtimes_keep_the_table() -> None:
    assert airtime_s(SLOW, 300) == pytest.approx(0.448e-3)
    assert airtime_s(SLOW, 541) == pytest.approx(0.77e-3, abs=0.005e-3)
    features = 1_060_000 // 8
    assert packet_count(SLOW, features) == 95
    assert message_airtime_s(SLOW, features) == pytest.approx(0.182, abs=0.0012)  # the last packet is short
    assert message_airtime_s(FAST, features) == pytest.approx(0.0433, abs=0.0005)
    assert message_airtime_s(SLOW, 960_000) == pytest.approx(1.31, abs=0.01)
    assert cpm_bytes(10) == pytest.approx(541, abs=40)


def test_whole_features_seldom_arrive() -> None:
    """95 packets of 99 % each arrive together in 38 of 100 cases."""
    assert 0.99 ** packet_count(SLOW, 132_500) == pytest.approx(0.385, abs=0.005)


@pytest.mark.parametrize("environment", ["urban", "highway"])
def test_path_loss_grows_with_distance_and_with_what_is_between(environment: str) -> None:
    distance = np.geomspace(2.0, 1000.0, 60)
    free, vehicle = (path_loss_db(distance, s, environment) for s in (Obstruction.FREE, Obstruction.VEHICLE))
    assert (np.diff(free) > 0).all() and (np.diff(vehicle) > 0).all()
    assert (vehicle >= free + 9.0 - 1e-9).all()


@pytest.mark.parametrize("sight", list(Obstruction))
def test_packets_arrive_as_often_as_the_link_budget_says(sight: Obstruction) -> None:
    """Over many links, whatever part of the variance is shadowing."""
    spec = replace(FAST, collision_share=0.0)
    distance = {Obstruction.FREE: 200.0, Obstruction.VEHICLE: 70.0, Obstruction.BUILDING: 25.0}[sight]
    instant = at(0, [(0.0, 0.0), (distance, 0.0)], size=20 * 1400, sight=sight)
    share = np.mean([Channel(spec, seed, 1.0).link(instant, 0, 1).arrived.mean() for seed in range(600)])
    assert share == pytest.approx(delivery_probability(spec, distance, sight), abs=0.05)


def test_shadowing_is_alike_nearby_and_both_ways() -> None:
    channels = [Channel(SLOW, seed, 0.1) for seed in range(400)]

    def shadow(x: float, ends: tuple[int, int] = (0, 1)) -> np.ndarray:
        places = np.array([[0.0, 0.0, 1.6], [x, 0.0, 1.6]])
        return np.array([c._shadow(*ends, places[::-1] if ends == (1, 0) else places) for c in channels])

    here = shadow(100.0)
    np.testing.assert_array_equal(here, shadow(100.0, (1, 0)))
    assert here.std() == pytest.approx(1.0, abs=0.1)
    near, far = (np.corrcoef(here, shadow(100.0 + step))[0, 1] for step in (10.0, 100.0))
    assert near == pytest.approx(math.exp(-1.0), abs=0.12)
    assert abs(far) < 0.15


def test_ideal_delivers_everything_at_once() -> None:
    channel = Channel(PRESETS["ideal"], 0, 0.1)
    for index in range(5):
        link = channel.newest([at(index, [(0.0, 0.0), (69.0, 0.0)], 10**7)], 0, 1)
        assert link.sent == index and link.age_s == 0.0 and link.arrived.all()


def test_paper_is_a_tenth_of_a_second_late_and_ends_at_seventy_metres() -> None:
    channel = Channel(PRESETS["paper"], 0, 0.1)
    drive = [at(index, [(0.0, 0.0), (69.0, 0.0), (71.0, 0.0)]) for index in (3, 2, 1, 0)]
    link = channel.newest(drive, 1, 0)
    assert link.sent == 2 and link.age_s == pytest.approx(0.1) and link.bytes == 132_500
    assert not channel.newest(drive, 2, 0).received
    assert not channel.newest(drive[-1:], 1, 0).received  # nothing was sent before the first instant


def test_links_do_not_depend_on_what_was_asked_before() -> None:
    drive = [at(index, [(0.0, 0.0), (150.0, 0.0), (40.0, 9.0)], 20_000) for index in range(9, -1, -1)]
    fresh = Channel(FAST, 5, 0.1).newest(drive, 1, 0)
    used = Channel(FAST, 5, 0.1)
    for first in range(9, 0, -1):
        used.newest(drive[first:], 2, 0)
    again = used.newest(drive, 1, 0)
    assert (again.sent, again.delay_s, again.bytes) == (fresh.sent, fresh.delay_s, fresh.bytes)
    np.testing.assert_array_equal(again.arrived, fresh.arrived)


def test_more_senders_make_messages_older() -> None:
    """Five feature messages of 43 ms each do not fit into 100 ms: some instants are left out."""

    def ages(count: int) -> float:
        drive = [at(i, [(5.0 * k, 0.0) for k in range(count)], 132_500) for i in range(60, -1, -1)]
        channel = Channel(FAST, 1, 0.1)
        return float(np.mean([channel.newest(drive[k:], 1, 0).age_s for k in range(30)]))

    assert ages(2) < ages(5)
    crowded = Channel(FAST, 1, 0.1).link(at(0, [(5.0 * k, 0.0) for k in range(5)], 132_500), 1, 0)
    alone = Channel(FAST, 1, 0.1).link(at(0, [(0.0, 0.0), (5.0, 0.0)], 300), 1, 0)
    assert alone.load < 0.05 < 0.3 < crowded.load <= 1.0


def test_a_reservation_that_collides_collides_throughout() -> None:
    spec = replace(PRESETS["c-v2x"], collision_share=1.0, power_dbm=60.0)
    channel = Channel(spec, 3, 0.1)
    places = [(4.0 * k, 0.0) for k in range(40)]
    lost = [not channel.link(at(i, places, 1200), 1, 0).arrived.any() for i in range(100)]
    blocks = np.array(lost).reshape(10, 10)
    assert (blocks.all(axis=1) | ~blocks.any(axis=1)).all()
    assert 0 < blocks.any(axis=1).sum() < 10


def test_tiles_of_lost_packets() -> None:
    arrived = np.ones(4, bool)
    assert not lost_tiles(arrived, 3, 4).any()
    arrived[1] = False
    np.testing.assert_array_equal(lost_tiles(arrived, 3, 4).ravel().nonzero()[0], [3, 4, 5])
    # More packets than tiles: a tile needs all of its packets.
    many = np.ones(12, bool)
    many[7] = False
    np.testing.assert_array_equal(lost_tiles(many, 2, 2).ravel().nonzero()[0], [2])
    assert lost_tiles(np.zeros(1, bool), 5, 5).all()


@pytest.mark.parametrize("packets", [1, 2, 3, 7, 95, 2200, 5000])
def test_as_many_tiles_are_lost_as_packets(packets: int) -> None:
    rng = np.random.default_rng(packets)
    arrived = rng.random(packets) > 0.3
    lost = lost_tiles(arrived, 25, 88)
    assert lost.any() == (~arrived).any() and lost.all() == (not arrived.any() or lost.mean() == 1.0)
    assert lost.mean() >= (~arrived).mean() - 1e-9


def test_trace_replays_delay_and_loss(tmp_path: Path) -> None:
    file = tmp_path / "trace.csv"
    file.write_text("time_s,sender,receiver,delay_s,loss\n0,*,*,0.0,0\n1.0,1,0,0.25,0\n2.0,*,*,0,1\n")
    channel = Channel(get_channel(f"trace:{file}"), 0, 0.5)
    drive = [at(index, [(0.0, 0.0), (30.0, 0.0)]) for index in range(5, -1, -1)]
    assert channel.newest(drive[5:], 1, 0).sent == 0
    late = channel.newest(drive[2:], 1, 0)  # instant 3 at 1.5 s is 0.25 s late: that of 1 s has arrived
    assert late.sent == 2 and late.age_s == pytest.approx(0.5)
    assert channel.newest(drive[:2], 1, 0).sent == -1


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("time_s,loss\n0,0\n", "delay_s"),
        ("time_s,delay_s,loss\n0,0,1.5\n", "line 2, loss: expected 0 to 1, found 1.5"),
        ("time_s,delay_s,loss\n0,x,0\n", "line 2, delay_s"),
        ("time_s,sender,delay_s,loss\n0,bob,0,0\n", "line 2, sender: expected the id of an agent"),
        ("time_s,delay_s,loss\n", "rows: expected at least one"),
    ],
)
def test_bad_traces_are_named(tmp_path: Path, content: str, message: str) -> None:
    file = tmp_path / "bad.csv"
    file.write_text(content)
    with pytest.raises(DataError, match=message):
        get_channel(f"trace:{file}")


def test_unknown_channels_are_named(tmp_path: Path) -> None:
    with pytest.raises(SettingsError, match="did you mean 'its-g5-6'"):
        get_channel("its-g5")
    with pytest.raises(SettingsError, match="trace:FILE"):
        get_channel("trace")
    with pytest.raises(DataError, match=r"nothing\.csv"):
        get_channel(f"trace:{tmp_path / 'nothing.csv'}")
    with pytest.raises(SettingsError, match="interval_s"):
        Channel(SLOW, 0, 0.0)


def test_an_agent_that_was_not_there_sent_nothing() -> None:
    channel = Channel(PRESETS["paper"], 0, 0.1)
    now, before = at(1, [(0.0, 0.0), (9.0, 0.0)]), at(0, [(0.0, 0.0), (9.0, 0.0)])
    alone = changed(before, agent_ids=(0, 7))
    assert channel.newest([now, before], 1, 0).received
    assert not channel.newest([now, alone], 1, 0).received


def test_a_negative_delay_is_told_its_bound(tmp_path: Path) -> None:
    file = tmp_path / "early.csv"
    file.write_text("time_s,delay_s,loss\n0,-1,0\n")
    with pytest.raises(DataError, match="delay_s: expected at least 0, found -1"):
        get_channel(f"trace:{file}")


def test_so_many_packets_are_lost_as_the_settings_say_and_each_by_itself() -> None:
    lossy = Channel(replace(PRESETS["ideal"], packet_loss=0.3), 1, 0.1)
    links = [lossy.link(at(i, [(0, 0), (20, 0)], 140_000), 1, 0) for i in range(100)]
    arrived = np.concatenate([link.arrived for link in links])
    assert arrived.mean() == pytest.approx(0.7, abs=0.02)
    assert np.corrcoef(arrived[:-1], arrived[1:])[0, 1] == pytest.approx(0.0, abs=0.03)
    assert links[0].probability == pytest.approx(0.7)


def test_instants_are_made_only_as_far_back_as_is_looked() -> None:
    class Made(list):
        asked: tuple = ()

        def __iter__(self) -> Iterator[object]:
            for i in range(len(self)):
                self.asked = (*self.asked, i)
                yield self[i]

    instants = Made(at(i, [(0, 0), (20, 0)]) for i in range(5, -1, -1))
    assert Channel(PRESETS["ideal"], 1, 0.1).newest(instants, 1, 0).sent == 5
    assert instants.asked == (0,)


def test_what_is_on_air_now_is_the_size_of_the_present_message() -> None:
    late = Channel(ChannelSpec(name="late", medium="fixed", delay_s=0.1), 1, 0.1)
    places = [(0.0, 0.0), (20.0, 0.0)]
    link = late.newest([at(1, places, 5_000), at(0, places, 1_000)], 1, 0)
    assert (link.sent, link.bytes, link.bytes_now) == (0, 1_000, 5_000)


def test_who_waits_for_its_turn_puts_nothing_on_air() -> None:
    """Four senders of 16 kB at 6 Mb/s: congestion control gives each every fifth instant."""
    channel = Channel(SLOW, 1, 0.1)
    places = [(0.0, 0.0), (20.0, 0.0), (40.0, 0.0), (60.0, 0.0)]
    links = [channel.newest([at(n, places, 16_000)], sender, 0) for n in range(50) for sender in (1, 2, 3)]
    sent = [link for link in links if not link.held]
    assert len(sent) == 3 * 10 and {link.bytes_now for link in sent} == {16_000}
    assert {link.bytes_now for link in links if link.held} == {0} and all(link.bytes == 16_000 for link in links)
    assert not any(link.received for link in links if link.held)
    older = channel.newest([at(n, places, 16_000) for n in range(8, -1, -1)], 1, 0)
    assert older.received and older.age_s > 0.0 and older.held and older.bytes_now == 0
    assert not any(Channel(PRESETS["ideal"], 1, 0.1).link(at(n, places), 1, 0).held for n in range(9))


EVERY = Radio("its-g5-6", **{name: 0.5 for name in CHANGES})


@pytest.mark.parametrize("radio", [Radio(), Radio("c-v2x", loss=0.3), Radio("paper", 0.0, 0.2, 0.4), EVERY])
def test_the_label_of_a_radio_is_read_back(radio: Radio) -> None:
    assert Radio.parse(radio.label) == radio


def test_lost_packets_need_no_trace() -> None:
    spec = get_channel("ideal,loss=0.3,delay_s=0.05,pose_error=0.2")
    assert (spec.packet_loss, spec.delay_s, spec.position_error_m, spec.heading_error_deg) == (0.3, 0.05, 0.2, 0.2)
    assert get_channel("ideal") == PRESETS["ideal"]


@pytest.mark.parametrize("text", ["ideal,loss=2", "ideal,loss=much", "ideal,delay_s=-1", "pigeon,loss=0.1"])
def test_a_wrong_change_of_a_channel_is_refused(text: str) -> None:
    with pytest.raises(SettingsError, match="channel"):
        get_channel(text)


def received(channel: Channel, count: int = 400, far_m: float = 20.0) -> list[bool]:
    places = [(0.0, 0.0), (far_m, 0.0)]
    return [channel.link(at(n, places, 1_000), 1, 0).received for n in range(count)]


def test_bursts_take_their_share_of_the_time_in_runs_of_their_length() -> None:
    spec = changed_spec(PRESETS["ideal"], {"burst_loss": 0.3, "burst_s": 1.0})
    there = received(Channel(spec, 3, 0.1), 20_000)
    lost = 1.0 - np.mean(there)
    runs = np.diff(np.flatnonzero(np.diff([True, *there, True])))[::2]
    assert lost == pytest.approx(0.3, abs=0.05) and np.mean(runs) == pytest.approx(10.0, rel=0.15)
    backwards = Channel(spec, 3, 0.1)
    places = [(0.0, 0.0), (20.0, 0.0)]
    assert [backwards.link(at(n, places), 1, 0).received for n in range(99, -1, -1)] == there[99::-1]


def test_jitter_delays_by_its_mean_and_never_comes_early() -> None:
    channel = Channel(changed_spec(PRESETS["ideal"], {"jitter_s": 0.2, "delay_s": 0.1}), 1, 0.1)
    places = [(0.0, 0.0), (20.0, 0.0)]
    delays = [channel.link(at(n, places), 1, 0).delay_s for n in range(2_000)]
    assert min(delays) >= 0.1 and np.mean(delays) == pytest.approx(0.3, abs=0.02)


def test_a_rate_of_2_hz_is_every_fifth_instant_and_a_range_is_an_end() -> None:
    there = np.flatnonzero(received(Channel(changed_spec(PRESETS["ideal"], {"message_hz": 2.0}), 1, 0.1), 50))
    assert len(there) == 10 and set(np.diff(there)) == {5}
    near = Channel(changed_spec(PRESETS["ideal"], {"range_m": 15.0}), 1, 0.1)
    assert not any(received(near, 5)) and all(received(near, 5, far_m=14.0))


def test_a_message_is_used_up_to_its_longest_age() -> None:
    late = Channel(changed_spec(PRESETS["ideal"], {"delay_s": 0.3, "longest_age_s": 0.3}), 1, 0.1)
    places = [(0.0, 0.0), (20.0, 0.0)]
    instants = [at(n, places) for n in range(9, -1, -1)]
    assert late.newest(instants, 1, 0).age_s == pytest.approx(0.3)
    old = Channel(changed_spec(late.spec, {"longest_age_s": 0.2}), 1, 0.1)
    assert not old.newest(instants, 1, 0).received


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("ideal,bandwidth=0", "changes: expected NAME=NUMBER of loss, .*, found bandwidth"),
        ("ideal,loss=0.1,loss=0.2", "changes: expected each once"),
    ],
)
def test_a_change_that_no_channel_has_or_that_is_there_twice_is_named(text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=f"^channel: {message}"):
        get_channel(text)


def test_a_channel_without_later_settings_has_the_key_that_it_had() -> None:
    """Results that are kept have it in their names."""
    known = PRESETS["its-g5-27"].decisive()
    assert {"packet_loss", "delay_s", "clock_error_s", "trace"} <= known.keys()
    assert not {"burst_loss", "burst_s", "jitter_s", "message_hz", "longest_age_s"} & known.keys()
    assert changed_spec(PRESETS["ideal"], {"jitter_s": 0.1}).decisive()["jitter_s"] == 0.1


def test_agents_without_a_radio_are_as_many_as_said_stay_so_and_are_among_those_of_a_larger_share() -> None:
    def silent(share: float, seed: int) -> set[int]:
        spec = replace(get_channel("ideal"), unequipped=share)
        channel = Channel(spec, seed, 0.1)
        instants = [at(index, [(10.0 * agent, 0.0) for agent in range(9)]) for index in range(3)]
        found = [{one for one in range(1, 9) if channel.link(now, one, 0).held} for now in instants]
        assert found[0] == found[1] == found[2]
        return found[0]

    some, more = ([silent(share, seed) for seed in range(100)] for share in (0.3, 0.6))
    assert all(few <= many for few, many in zip(some, more, strict=True))
    assert sum(map(len, some)) / 800 == pytest.approx(0.3, abs=0.05)
    assert sum(map(len, more)) / 800 == pytest.approx(0.6, abs=0.05)
    assert not silent(0.0, 0) and len(silent(1.0, 0)) == 8


def test_who_has_no_radio_loads_no_channel() -> None:
    street = at(0, [(10.0 * agent, 0.0) for agent in range(9)])
    loads = [Channel(replace(SLOW, unequipped=share), 0, 0.1).link(street, 0, 1).load for share in (0.0, 0.5, 1.0)]
    assert loads[0] > loads[1] > loads[2] == 0.0
