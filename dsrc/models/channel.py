"""What an ego gets of its collaborators through a radio channel: older, from where they believe to be, with holes.

The channel says which message of each collaborator is the newest that has arrived (`sim.radio`). Its points were measured
at that instant and are put where the sender believed to be then: its pose at the time that its clock showed, and the
error of its positioning. Of a feature map every lost packet is a hole. The ego has no error: everything is judged in
its own frame. Ground truth stays that of now, and of all agents in range whatever arrived.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dsrc.data.sample import Sample, cloud_of
from dsrc.models.compression import TILE_CELLS, message_bytes
from dsrc.models.fusion import FUSIONS
from dsrc.ops.grid import GridSpec
from sensors.corruptions.clock_offset import run_on, way
from sensors.corruptions.pose_error import PoseError, errors
from sensors.frame import AgentFrame, Frame
from sensors.scan.line_of_sight import antennas, lines_of_sight
from sim.geometry import invert, pose_matrix
from sim.radio import Channel, ChannelSpec, Instant, Link, cpm_bytes, lost_tiles

Payload = Callable[[Frame, int], int]
"""(frame, row of an agent) -> bytes that it has to send."""

_CLOUDS = ("", "early")
"""What a detector without a name for it, and one of early fusion, get of the others: points."""

_POSITION = 6  # stream of the senders' positioning, beside those of `sim.radio`


class Receiver:
    """The receiving end of an ego over a drive.

    Args:
        spec: of the channel.
        seed: of the drive's channel.
        interval_s: between frames, s.
        settings: of the detector, which say what the agents send, see `payload_of`.
    """

    def __init__(self, spec: ChannelSpec, seed: int, interval_s: float, settings: Any) -> None:
        self.channel = Channel(spec, seed, interval_s)
        self.payload = payload_of(settings, spec)
        self._fusion = getattr(settings, "fusion", "")

    def receive(
        self, frames: Sequence[Frame], position: int, sample: Sample, grid: GridSpec
    ) -> tuple[Sample, tuple[Link, ...]]:
        """Return the sample as the ego has it, and the link from each collaborator in the order of the sample.

        Args:
            frames: now first, then the ones before it, newest first, as far back as there are any.
            position: of the first in the drive; those before it have one less each.
            sample: what the ego would have if everything arrived at once.
            grid: that the sample was cropped to.
        """
        ego, others = sample.agent_ids[0], sample.agent_ids[1:]
        instants = _Lazy(frames, position, self.payload)
        links = tuple(self.channel.newest(instants, agent, ego) for agent in others)
        ego_from_world = invert(frames[0].agent(ego).sweep.world_from_lidar)
        rows, poses, clouds, lost = [0], [sample.ego_from_agent[0]], [sample.clouds[0]], [_NOTHING]
        for row, link in enumerate(links, start=1):
            if not link.heard:
                continue
            sent = frames[position - link.sent]
            sender = sent.agent(link.sender)
            pose, cloud = sample.ego_from_agent[row], sample.clouds[row]
            believed = self._believed(sender, sent.time_s, link.sent)
            if sent is not frames[0] or believed is not sender.sweep.world_from_lidar:
                pose = ego_from_world @ believed
                cloud = cloud_of(sent, sent.agents.index(sender), pose, grid)
            if self._fusion in _CLOUDS:
                cloud = cloud[_of_packets(len(cloud), link.arrived)]
            rows.append(row)
            poses.append(pose)
            clouds.append(cloud)
            lost.append(self._holes(link, grid))
        heard = replace(
            sample,
            agent_ids=tuple(sample.agent_ids[row] for row in rows),
            clouds=tuple(clouds),
            ego_from_agent=np.stack(poses),
            agent_boxes=tuple(sample.agent_boxes[row] for row in rows),
            lost=tuple(lost) if any(part.size for part in lost) else (),
        )
        return heard, links

    def _holes(self, link: Link, grid: GridSpec) -> NDArray[np.bool_]:
        """Return the tiles of the sender's features that are missing; a list of boxes or a cloud has no tiles."""
        if self._fusion in (*_CLOUDS, "late") or link.arrived.all():
            return _NOTHING
        return lost_tiles(link.arrived, grid.height // TILE_CELLS, grid.width // TILE_CELLS)

    def _believed(self, sender: AgentFrame, time_s: float, index: int) -> NDArray[np.float64]:
        """Return world_from_lidar (4, 4) as the sender believes it; the very same array when it is right."""
        spec, channel = self.channel.spec, self.channel
        pose = sender.sweep.world_from_lidar
        ahead_s = channel.clock_error_s(sender.agent_id)
        if ahead_s != 0.0 and sender.kind == "vehicle":
            pose = run_on(way(sender), np.array([sender.sweep.time_s + ahead_s]))[0]
        if spec.position_error_m == 0.0 and spec.heading_error_deg == 0.0:
            return pose
        body = sender.world_from_body
        return body @ self._deviation(sender, time_s, index) @ invert(body) @ pose

    def _deviation(self, sender: AgentFrame, time_s: float, index: int) -> NDArray[np.float64]:
        """Return believed_from_true (4, 4) in the sender's body frame; that of a roadside unit stays."""
        spec, still = self.channel.spec, sender.kind != "vehicle"
        steady = still or spec.error_correlation_s > 0.0
        key = (_POSITION, sender.agent_id % 2**32, *(() if steady else (index,)))
        rng = np.random.default_rng(np.random.SeedSequence(self.channel.seed, spawn_key=key))
        if steady:
            settings = PoseError(
                lateral_m=spec.position_error_m,
                longitudinal_m=spec.position_error_m,
                heading_deg=spec.heading_error_deg,
                correlation_s=spec.error_correlation_s or 1.0,
            )
            ahead, aside, turn = errors(settings, 0.0 if still else time_s, rng)
        else:
            scale = [spec.position_error_m, spec.position_error_m, math.radians(spec.heading_error_deg)]
            ahead, aside, turn = rng.standard_normal(3) * scale
        return pose_matrix([ahead, aside, 0.0], turn)


_NOTHING = np.zeros((0, 0), bool)


def _of_packets(points: int, arrived: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (points,) whether a point was in a packet that arrived; they are sent in their order."""
    return arrived[np.arange(points) * len(arrived) // max(points, 1)]


class _Lazy(Sequence[Instant]):
    """The instants of frames, made when they are looked at: most messages are of the newest two."""

    def __init__(self, frames: Sequence[Frame], position: int, payload: Payload) -> None:
        self._frames, self._position, self._payload = frames, position, payload
        self._made: dict[int, Instant] = {}

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, which: Any) -> Any:
        if isinstance(which, slice):
            return [self[i] for i in range(*which.indices(len(self)))]
        if not 0 <= which < len(self):
            raise IndexError(which)
        if which not in self._made:
            self._made[which] = instant_of(self._frames[which], self._position - which, self._payload)
        return self._made[which]


def instant_of(frame: Frame, index: int, payload: Payload) -> Instant:
    """Return what the channel needs to know of a frame; where nobody knows its world, only vehicles are in the way."""
    sight = frame.sight if (frame.sight >= 0).all() else lines_of_sight(None, frame)
    ids = tuple(agent.agent_id for agent in frame.agents)
    return Instant(index, ids, antennas(frame), tuple(payload(frame, row) for row in range(len(ids))), sight)


def payload_of(settings: Any, spec: ChannelSpec) -> Payload:
    """Return what agents send to a detector.

    Features: the tiles of the maps that its method sends, in numbers of as many bits as `settings` say
    (`dsrc.models.compression`), `spec.compression` times smaller; of Where2comm the whole first scale, of which it sends a
    share that depends on what is seen. Late fusion: a Collective Perception Message with
    the objects that the agent has points on, in place of its detections. Early fusion: clouds.

    Args:
        settings: `ModelSettings` of the detector; anything without a `fusion` reads clouds, of 16 bytes a point.
        spec: of the channel.
    """
    fusion = getattr(settings, "fusion", "")
    if fusion == "late":
        return lambda frame, row: cpm_bytes(int(((frame.points_on[row] >= 1) & frame.truth.is_vehicle).sum()))
    if fusion in _CLOUDS:
        return lambda frame, row: 16 * len(frame.agents[row].sweep)
    method = FUSIONS[fusion]
    message = message_bytes(settings, method.values_sent(settings), method.channels_sent(settings))
    size = math.ceil(message / spec.compression)
    return lambda frame, row: size
