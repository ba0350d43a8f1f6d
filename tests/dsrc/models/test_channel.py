"""What the ego gets through a channel: nothing changes without loss, and what is late, misplaced or lost shows."""

from dataclasses import replace as changed
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from msgspec.structs import replace

from dsrc.data.sample import Sample, make_sample
from dsrc.models.channel import Receiver, payload_of, snapshot_of
from dsrc.models.detector import Detector, NetworkOutput
from dsrc.models.settings import ModelSettings
from dsrc.ops.grid import GridSpec
from sim.geometry import invert
from sim.radio import PRESETS, Obstruction, cpm_bytes
from sim.radio.spec import ChannelSpec
from tests.dsrc.data.toy import toy_frame

GRID = GridSpec((-38.4, -38.4, -3.0, 38.4, 38.4, 1.0), 0.8)
SMALL = ModelSettings(
    grid=GRID,
    stage_channels=(8, 16, 16),
    stage_blocks=(1, 1, 1),
    pillar_channels=8,
    base_width=64,
    decoder_channels=8,
    shrink_channels=8,
    rec=False,
    sdd=False,
    pcp=False,
)
FRAMES = [toy_frame(index) for index in range(6)]
STILL = replace(PRESETS["paper"], position_error_m=0.0, heading_error_deg=0.0)


def through(spec: ChannelSpec, position: int = 5, settings: ModelSettings = SMALL, seed: int = 0) -> tuple:
    frames = FRAMES[position::-1]
    sample = make_sample(frames[0], 1000, GRID)
    return sample, *Receiver(spec, seed, 0.1, settings).receive(frames, position, sample, GRID)


def test_an_ideal_channel_changes_no_bit() -> None:
    sample, heard, links = through(PRESETS["ideal"])
    assert heard.agent_ids == sample.agent_ids and heard.lost == ()
    for ours, theirs in zip(heard.clouds, sample.clouds, strict=True):
        assert ours.tobytes() == theirs.tobytes()
    assert heard.ego_from_agent.tobytes() == sample.ego_from_agent.tobytes()
    detector = Detector(SMALL).eval()
    with_channel, without = detector.detect(heard), detector.detect(sample)
    assert with_channel.score.tobytes() == without.score.tobytes()
    assert all(link.age_s == 0.0 for link in links) and len(links) == 2


def test_a_late_message_is_the_earlier_sweep_from_the_earlier_place() -> None:
    sample, heard, links = through(STILL)
    assert [link.sent for link in links] == [4, 4]
    assert heard.clouds[0] is sample.clouds[0]
    sender, now = FRAMES[4].agent(1002), FRAMES[5].agent(1000)
    expected = invert(now.sweep.world_from_lidar) @ sender.sweep.world_from_lidar
    np.testing.assert_allclose(heard.ego_from_agent[1], expected, atol=1e-9)
    earlier = make_sample(FRAMES[4], 1000, GRID)
    assert abs(len(heard.clouds[1]) - len(earlier.clouds[1])) < 20
    assert not np.array_equal(heard.clouds[1], sample.clouds[1])


def test_ground_truth_is_that_of_now_whatever_arrives() -> None:
    silent = replace(PRESETS["ideal"], range_m=0.5)
    sample, heard, links = through(silent)
    assert heard.agent_ids == (1000,) and not any(link.received for link in links)
    np.testing.assert_array_equal(heard.boxes.array, sample.boxes.array)


def test_errors_of_position_move_a_vehicle_by_as_much_as_they_say() -> None:
    spec = replace(PRESETS["ideal"], position_error_m=0.5, heading_error_deg=0.0)
    moved = []
    for seed in range(300):
        sample, heard, _ = through(spec, position=0, seed=seed)
        moved.append((heard.ego_from_agent - sample.ego_from_agent)[:, :3, 3])
    moved = np.array(moved)
    assert (moved[:, 0] == 0.0).all()  # the ego's own
    np.testing.assert_allclose(moved[:, 1:, :2].std(axis=0), 0.5, rtol=0.15)


def test_correlated_errors_stay_alike_and_white_ones_do_not() -> None:
    def steps(spec: ChannelSpec) -> np.ndarray:
        errors = []
        for position in range(6):
            sample, heard, _ = through(spec, position)
            errors.append((heard.ego_from_agent - sample.ego_from_agent)[1, :2, 3])
        return np.linalg.norm(np.diff(errors, axis=0), axis=1)

    white = replace(PRESETS["ideal"], position_error_m=1.0)
    assert steps(replace(white, error_correlation_s=30.0)).max() < 0.3 * steps(white).mean()


def test_a_fast_clock_puts_a_moving_sender_ahead_and_leaves_a_mast_where_it_is() -> None:
    sample, heard, _ = through(replace(PRESETS["ideal"], clock_error_s=0.1))
    moved = np.linalg.norm((heard.ego_from_agent - sample.ego_from_agent)[:, :3, 3], axis=1)
    assert moved[0] == moved[2] == 0.0 and 0.0 < moved[1] < 7.25 * 0.5


def test_lost_packets_are_holes_in_the_features() -> None:
    torch.manual_seed(0)
    detector = Detector(SMALL).eval()
    sample = make_sample(FRAMES[0], 1000, GRID)
    height, width = GRID.height // 8, GRID.width // 8
    none, everything = np.zeros((height, width), bool), np.ones((height, width), bool)
    alone = make_sample(FRAMES[0], 1000, GRID, cooperative=False)

    def stages(part: Sample) -> NetworkOutput:
        from dsrc.models.inputs.batch import collate

        batch = collate([part], SMALL, training=False)
        return detector(batch.student, batch.layout)

    with torch.inference_mode():
        whole = stages(sample)
        same = stages(changed(sample, lost=(none, none, none)))
        silent = stages(changed(sample, lost=(none, everything, everything)))
        half = np.zeros((height, width), bool)
        half[: height // 2] = True
        partly = stages(changed(sample, lost=(none, half, half)))
        lonely = stages(alone)
    torch.testing.assert_close(whole.fused, same.fused)
    assert not torch.allclose(whole.fused, silent.fused)
    assert not torch.allclose(silent.fused, lonely.fused)  # zeros still draw some of the attention
    # Far from the border of the holes the kept half is as if all had arrived.
    torch.testing.assert_close(partly.fused[..., -height:, :], whole.fused[..., -height:, :])
    assert not torch.allclose(partly.fused[..., :height, :], whole.fused[..., :height, :])


def test_the_fraction_of_a_map_that_is_lost_is_that_of_the_packets() -> None:
    spec = replace(
        PRESETS["its-g5-27"], congestion_control=False, delay_s=0.0, compression=100.0, snr_db=38.0, packet_bytes=50
    )
    shares = []
    for seed in range(120):
        _, heard, links = through(spec, seed=seed)
        if heard.lost:
            for link, part in zip([k for k in links if k.received], heard.lost[1:], strict=True):
                share = part.mean() if part.size else 0.0
                assert (~link.arrived).mean() - 1e-9 <= share <= (~link.arrived).mean() + len(link.arrived) / 144
                shares.append(share)
    assert len(shares) > 10 and 0.0 < np.mean(shares) < 0.5


def test_bytes_are_those_of_what_is_sent() -> None:
    frame = FRAMES[0]
    values = 48 * 48 * 8 + 24 * 24 * 16 + 12 * 12 * 16
    assert payload_of(SMALL, PRESETS["ideal"])(frame, 0) == 4 * values
    assert payload_of(SMALL, replace(PRESETS["ideal"], compression=10.0))(frame, 0) == -(-4 * values // 10)
    objects = int(((frame.points_on[1] >= 1) & frame.truth.is_vehicle).sum())
    late = ModelSettings(grid=GRID, fusion="late")
    assert payload_of(late, PRESETS["ideal"])(frame, 1) == 156 + 35 * objects
    early = ModelSettings(grid=GRID, fusion="early")
    for clouds in (SimpleNamespace(request=early.request), early):
        assert payload_of(clouds, PRESETS["ideal"])(frame, 1) == 16 * len(frame.agents[1].sweep)
    one_map = ModelSettings(grid=GRID, fusion="cobevt", shrink_channels=32, compress=4)
    assert payload_of(one_map, PRESETS["ideal"])(frame, 0) == 4 * 32 * (GRID.width // 4) * (GRID.height // 4) // 4


def test_joined_detectors_send_what_each_of_them_needs_and_one_cloud_for_all() -> None:
    frame, ideal = FRAMES[0], PRESETS["ideal"]
    people = replace(SMALL, users="vulnerable", grid=GridSpec((-19.2, -19.2, -3.0, 19.2, 19.2, 1.0), 0.8))
    both = Receiver(ideal, 0, 0.1, SMALL, [people]).payload
    assert both(frame, 0) == payload_of(SMALL, ideal)(frame, 0) + payload_of(people, ideal)(frame, 0)
    early = [ModelSettings(grid=GRID, fusion="early", users=users) for users in ("vehicles", "vulnerable")]
    assert Receiver(ideal, 0, 0.1, early[0], early[1:]).payload(frame, 0) == payload_of(early[0], ideal)(frame, 0)
    late = payload_of(ModelSettings(grid=GRID, fusion="late", users="vulnerable"), ideal)
    seen = int(((frame.points_on[1] >= 1) & frame.truth.is_vulnerable).sum())
    assert seen and late(frame, 1) == cpm_bytes(seen)


def test_clouds_lose_the_points_of_lost_packets() -> None:
    spec = replace(PRESETS["its-g5-27"], congestion_control=False, delay_s=0.0, snr_db=43.0, position_error_m=0.0)
    spec = replace(spec, heading_error_deg=0.0, clock_error_s=0.0, packet_bytes=16)
    sample, heard, links = through(spec, settings=object(), seed=4)
    for link in links:
        if link.received and link.sent == 5:
            row = heard.agent_ids.index(link.sender)
            whole = sample.clouds[sample.agent_ids.index(link.sender)]
            assert len(heard.clouds[row]) == pytest.approx(link.arrived.mean() * len(whole), rel=0.2)


def test_a_frame_of_unknown_sight_counts_the_vehicles_between() -> None:
    frame = changed(FRAMES[0], sight=np.full((3, 3), -1, np.int8))
    instant = snapshot_of(frame, 0, lambda frame, row: 1)
    assert set(np.unique(instant.sight)) <= {int(Obstruction.FREE), int(Obstruction.VEHICLE)}
    assert snapshot_of(FRAMES[0], 0, lambda frame, row: 1).sight.max() == Obstruction.BUILDING
