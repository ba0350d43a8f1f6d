"""Radio channel of a detector's input: collaborators' clouds late, misplaced by their pose errors, with lost packets.

The channel selects the newest message of each collaborator that has arrived (`sim.radio`). Its points were measured at
the time of sending and are placed by the sender's believed pose: that at the time of its clock, with the error of its
positioning. A lost packet is a hole in a feature map. The ego has no error. Ground truth is that of the current frame
and of all agents in range, whatever arrived.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import DetectorSettings, Sample, cloud_of, users_in
from dsrc.models.compression import TILE_CELLS, message_bytes
from dsrc.models.fusion import FUSIONS
from dsrc.models.settings import ModelSettings, fusion_of
from dsrc.ops.grid import GridSpec
from dsrc.ops.ground import CELL_M
from sensors.corruptions.clock_offset import extrapolate, sensor_path
from sensors.corruptions.pose_error import PoseError, pose_errors
from sensors.frame import AgentFrame, Frame
from sensors.scan.line_of_sight import antennas, lines_of_sight
from sim.geometry import invert, pose_matrix
from sim.radio import Channel, ChannelSpec, Link, RadioSnapshot, cpm_bytes, lost_tiles
from sim.streams import Stream, random_generator

Payload = Callable[[Frame, int], int]
"""(frame, row of an agent) -> bytes of its message."""


class Receiver:
    """Receiver of an ego over a drive.

    Args:
        settings: settings of the detector, which decide the messages, see `payload_of`.
        joined: settings of detectors joined to it, whose maps or objects travel in the same messages.
        faulted: settings of the channel by instant and sender, see `sim.radio.Channel`.
    """

    def __init__(
        self,
        spec: ChannelSpec,
        seed: int,
        interval_s: float,
        settings: DetectorSettings,
        joined: Sequence[DetectorSettings] = (),
        faulted: Callable[[int, int], ChannelSpec] | None = None,
    ) -> None:
        self.channel = Channel(spec, seed, interval_s, faulted)
        self._fusion = fusion_of(settings)
        # One cloud is for all of them.
        parts = [payload_of(one, spec) for one in (settings, *(() if self._fusion == "early" else joined))]
        self.payload: Payload = lambda frame, row: sum(part(frame, row) for part in parts)

    def receive(
        self, frames: Sequence[Frame], position: int, sample: Sample, grid: GridSpec
    ) -> tuple[Sample, tuple[Link, ...]]:
        """Return the sample with received data only, and the links from the collaborators in the sample's order.

        Args:
            frames: the current frame and those before it, newest first.
            position: position of the current frame in the drive.
            grid: range that the sample was cropped to.
        """
        ego, others = sample.agent_ids[0], sample.agent_ids[1:]
        links = self.links(frames, position, ego, others)
        ego_from_world = sample.ego_from_agent[0] @ invert(frames[0].agent(ego).sweep.world_from_lidar)
        rows, poses, clouds, lost = [0], [sample.ego_from_agent[0]], [sample.clouds[0]], [_ALL_ARRIVED]
        for row, link in enumerate(links, start=1):
            if not link.received:
                continue
            sent = frames[position - link.sent]
            sender = sent.agent(link.sender)
            pose, cloud = sample.ego_from_agent[row], sample.clouds[row]
            believed = self.believed_pose(sender, sent.time_s, link.sent)
            if sent is not frames[0] or believed is not sender.sweep.world_from_lidar:
                pose = ego_from_world @ believed
                cloud = cloud_of(sent, sent.agents.index(sender), pose, grid)
            if self._fusion == "early":  # points are sent in order
                cloud = cloud[link.arrived[np.arange(len(cloud)) * len(link.arrived) // max(len(cloud), 1)]]
            rows.append(row)
            poses.append(pose)
            clouds.append(cloud)
            lost.append(self._lost_tiles(link, grid))
        received = replace(
            sample,
            agent_ids=tuple(sample.agent_ids[row] for row in rows),
            clouds=tuple(clouds),
            ego_from_agent=np.stack(poses),
            agent_boxes=tuple(sample.agent_boxes[row] for row in rows),
            lost=tuple(lost) if any(part.size for part in lost) else (),
        )
        return received, links

    def links(self, frames: Sequence[Frame], position: int, ego: int, others: Sequence[int]) -> tuple[Link, ...]:
        """Return the links from other agents to an ego, the newest; `frames` and `position` as in `receive`."""
        snapshots = _Snapshots(frames, position, self.payload)
        return tuple(self.channel.newest(snapshots, agent, ego) for agent in others)

    def arrived(self, frames: Sequence[Frame], position: int, sender: int, ego: int) -> list[int]:
        """Return the numbers of the instants whose message of a sender has arrived by now, in their order.

        `frames` and `position` as in `receive`.
        """
        snapshots = _Snapshots(frames, position, self.payload)
        longest_s = self.channel.sent_with(position, sender).longest_age_s
        found = []
        for age in range(len(frames) - 1, -1, -1):
            ids, age_s = snapshots[age].agent_ids, age * self.channel.interval_s
            if longest_s is not None and age_s > longest_s + 1e-9:
                continue
            if sender in ids and ego in ids:
                link = self.channel.link(snapshots[age], sender, ego)
                if link.received and link.delay_s <= age_s + 1e-9:
                    found.append(position - age)
        return found

    def held(self, frames: Sequence[Frame], position: int, sender: int, ego: int) -> bool:
        """Whether a sender may send nothing now; `frames` and `position` as in `receive`."""
        return self.channel.link(_Snapshots(frames, position, self.payload)[0], sender, ego).held

    def _lost_tiles(self, link: Link, grid: GridSpec) -> NDArray[np.bool_]:
        """Return the lost tiles of the sender's features; lists of boxes and clouds have no tiles."""
        if self._fusion in ("early", "late") or link.arrived.all():
            return _ALL_ARRIVED
        return lost_tiles(link.arrived, grid.height // TILE_CELLS, grid.width // TILE_CELLS)

    def believed_pose(self, sender: AgentFrame, time_s: float, index: int) -> NDArray[np.float64]:
        """Return the sender's believed world_from_lidar (4, 4); the same array without any error."""
        channel = self.channel
        spec = channel.sent_with(index, sender.agent_id)
        pose = sender.sweep.world_from_lidar
        ahead_s = channel.clock_error_s(sender.agent_id)
        if ahead_s != 0.0 and sender.kind == "vehicle":
            pose = extrapolate(sensor_path(sender), np.array([sender.sweep.time_s + ahead_s]))[0]
        if spec.position_error_m == 0.0 and spec.heading_error_deg == 0.0:
            return pose
        body = sender.world_from_body
        return body @ self._pose_error(sender, time_s, index) @ invert(body) @ pose

    def _pose_error(self, sender: AgentFrame, time_s: float, index: int) -> NDArray[np.float64]:
        """Return believed_from_true (4, 4) in the sender's body frame, constant for a roadside unit."""
        spec, still = self.channel.sent_with(index, sender.agent_id), sender.kind != "vehicle"
        steady = still or spec.error_correlation_s > 0.0
        keys = (sender.agent_id,) if steady else (sender.agent_id, index)
        rng = random_generator(self.channel.seed, Stream.RADIO_POSITION, *keys)
        if steady:
            settings = PoseError(
                lateral_m=spec.position_error_m,
                longitudinal_m=spec.position_error_m,
                heading_deg=spec.heading_error_deg,
                correlation_s=spec.error_correlation_s or 1.0,
            )
            ahead, aside, turn = pose_errors(settings, 0.0 if still else time_s, rng)
        else:
            scale = [spec.position_error_m, spec.position_error_m, math.radians(spec.heading_error_deg)]
            ahead, aside, turn = rng.standard_normal(3) * scale
        return pose_matrix([ahead, aside, 0.0], turn)


_ALL_ARRIVED = np.zeros((0, 0), bool)


class _Snapshots(Sequence[RadioSnapshot]):
    """Radio snapshots of frames, made on access: most messages are of the newest two."""

    def __init__(self, frames: Sequence[Frame], position: int, payload: Payload) -> None:
        self._frames, self._position, self._payload = frames, position, payload
        self._made: dict[int, RadioSnapshot] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, which: Any) -> Any:
        if isinstance(which, slice):
            return [self[i] for i in range(*which.indices(len(self)))]
        if not 0 <= which < len(self):
            raise IndexError(which)
        if which not in self._made:
            self._made[which] = snapshot_of(self._frames[which], self._position - which, self._payload)
        return self._made[which]


def snapshot_of(frame: Frame, index: int, payload: Payload) -> RadioSnapshot:
    """Return a frame's radio snapshot; where its world is unknown, only vehicles obstruct."""
    sight = frame.sight if (frame.sight >= 0).all() else lines_of_sight(None, frame)
    ids = tuple(agent.agent_id for agent in frame.agents)
    return RadioSnapshot(index, ids, antennas(frame), tuple(payload(frame, row) for row in range(len(ids))), sight)


def payload_of(settings: DetectorSettings, spec: ChannelSpec) -> Payload:
    """Return the message size of agents for a detector.

    Features: the tiles of the maps that its method sends, in numbers of `settings.bits` (`dsrc.models.compression`),
    divided by `spec.compression`; for Where2comm the whole first scale, of which it sends a share that depends on the
    scene. With heights above the ground, the surface comes with them, of 2 bytes a cell. Late fusion: a Collective
    Perception Message with the objects that the agent has points on, in place of its detections. Early fusion: clouds.

    Args:
        settings: without those of `ModelSettings` a detector reads clouds, of 16 bytes a point.
    """
    if not isinstance(settings, ModelSettings) or settings.fusion == "early":
        return lambda frame, row: 16 * len(frame.agents[row].sweep)
    if settings.fusion == "late":
        users = settings.users
        return lambda frame, row: cpm_bytes(int(((frame.points_on[row] >= 1) & users_in(frame.truth, users)).sum()))
    method = FUSIONS[settings.fusion]
    message = message_bytes(settings, method.values_sent(settings), method.channels_sent(settings))
    size = math.ceil(message / spec.compression) + _ground_bytes(settings)
    return lambda frame, row: size


def _ground_bytes(settings: ModelSettings) -> int:
    """Return the bytes of the surface below an agent's cloud, which puts boxes on ground that the ego does not see."""
    if settings.height == "sensor":
        return 0
    x0, y0, _, x1, y1, _ = settings.grid.range_m
    return 2 * math.ceil((x1 - x0) / CELL_M) * math.ceil((y1 - y0) / CELL_M)
