"""Agent-object pose graph: collaborators' poses corrected by objects that several agents detect."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from dsrc.data.sample import Sample
from dsrc.ops.detections import Detections
from dsrc.ops.grid import GridSpec
from sim.geometry import pose_matrix, transform_points

SAME_OBJECT_M = 1.5
"""Distance of centres below which boxes of two agents are one object."""
FEWEST_OBJECTS = 4
"""Least number of shared objects; an agent with fewer than two of them keeps its pose."""
BOX_M, BOX_RAD = 0.3, 0.06
"""Standard deviation of a detector's box positions and headings."""
POSE_M, POSE_RAD = 2.0, 0.1
"""Standard deviation of the agents' poses: wide enough for objects to decide, a prior for agents without any."""


def corrections(detections: Sequence[Detections], place: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the pose correction of each agent, a motion of its points in the ego's frame.

    Source: CoAlign, arXiv 2211.07214, Section IV-A, Equation 2: agents and objects are nodes with a place and a
    heading, each detection is an edge; all are moved until the edges agree best, the ego being fixed. Headings are
    compared modulo half a turn, as a detector without a direction head leaves it open.

    Released: information from log-variances that a first detector predicts, g2o without a robust norm, no prior on the
    poses. Here boxes are weighted by their scores under a soft L1 norm, with a weak prior on the poses.

    Args:
        detections: of each agent's cloud alone, in the ego's frame as believed; ego first.
        place: (A, 2) believed positions of the agents in the ego's frame, m.

    Returns:
        (A, 4, 4) float64, the identity for the ego and for agents with too few objects.
    """
    agents = len(detections)
    still = np.tile(np.eye(4), (agents, 1, 1))
    agent, landmark, box, weight = _edges(detections)
    shared = np.array([len(np.unique(landmark[agent == a])) for a in range(agents)])
    objects = int(landmark.max(initial=-1)) + 1
    if objects < FEWEST_OBJECTS or agents < 2:
        return still
    first = np.array([box[landmark == k][0] for k in range(objects)])
    strength = np.sqrt(weight)[:, None] / [BOX_M, BOX_M, BOX_RAD]

    def residuals(free: NDArray[np.float64]) -> NDArray[np.float64]:
        moved = np.concatenate([np.zeros((1, 3)), free[: 3 * (agents - 1)].reshape(-1, 3)])
        nodes = free[3 * (agents - 1) :].reshape(-1, 3)
        found = _moved(box, place[agent], moved[agent])
        error = found - nodes[landmark]
        # Half a turn is no difference; the sine keeps the function smooth.
        error[:, 2] = np.sin(2 * error[:, 2]) / 2
        return np.concatenate([(error * strength).ravel(), (moved[1:] / [POSE_M, POSE_M, POSE_RAD]).ravel()])

    start = np.concatenate([np.zeros(3 * (agents - 1)), first.ravel()])
    moved = least_squares(residuals, start, loss="soft_l1", max_nfev=100).x[: 3 * (agents - 1)].reshape(-1, 3)
    for a in range(1, agents):
        if shared[a] >= 2:
            there, (x, y, turn) = np.array([*place[a], 0.0]), moved[a - 1]
            still[a] = pose_matrix(there + np.array([x, y, 0.0]), turn) @ pose_matrix(-there)
    return still


def _moved(box: NDArray[np.float64], about: NDArray[np.float64], by: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn (E, 3) x, y, yaw about (E, 2) points and shift them, by (E, 3) x, y, angle."""
    cos, sin = np.cos(by[:, 2]), np.sin(by[:, 2])
    x, y = (box[:, :2] - about).T
    turned = np.stack([cos * x - sin * y, sin * x + cos * y], axis=1) + about + by[:, :2]
    return np.concatenate([turned, (box[:, 2] + by[:, 2])[:, None]], axis=1)


def _edges(
    detections: Sequence[Detections],
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Return agent, object, box (x, y, yaw) and score per edge; objects of a single agent are left out."""
    agent = np.concatenate([np.full(len(found), a) for a, found in enumerate(detections)])
    box = np.concatenate([np.column_stack([d.boxes.center[:, :2], d.boxes.yaw]) for d in detections]).reshape(-1, 3)
    score = np.concatenate([found.score for found in detections]).astype(np.float64)
    landmark = np.full(len(agent), -1)
    objects = 0
    for seed in np.argsort(-score, kind="stable"):
        if landmark[seed] >= 0:
            continue
        distance = np.linalg.norm(box[:, :2] - box[seed, :2], axis=1)
        near = np.flatnonzero((distance < SAME_OBJECT_M) & (landmark < 0) & (agent != agent[seed]))
        # The nearest one of each other agent.
        members = [near[agent[near] == a][distance[near[agent[near] == a]].argmin()] for a in np.unique(agent[near])]
        if members:
            landmark[[seed, *members]] = objects
            objects += 1
    kept = landmark >= 0
    return agent[kept], landmark[kept], box[kept], score[kept]


def aligned(sample: Sample, detections: Sequence[Detections], grid: GridSpec) -> Sample:
    """Correct the poses of a sample's first agents, those with detections.

    Args:
        detections: detections in each agent's cloud alone, in the ego's frame.
        grid: range that moved clouds are cropped to; points outside it by the believed poses are lost.
    """
    moves = corrections(detections, sample.ego_from_agent[: len(detections), :2, 3])
    low, high = np.array(grid.range_m[:3]), np.array(grid.range_m[3:])
    clouds, poses = list(sample.clouds), sample.ego_from_agent.copy()
    for row, move in enumerate(moves):
        if np.array_equal(move, np.eye(4)):
            continue
        cloud = clouds[row].copy()
        cloud[:, :3] = transform_points(move, cloud[:, :3])
        clouds[row] = cloud[((cloud[:, :3] > low) & (cloud[:, :3] < high)).all(axis=1)]
        poses[row] = move @ poses[row]
    return replace(sample, clouds=tuple(clouds), ego_from_agent=poses)
