"""Frame, heights and intensities that a network was trained with, where they are not those of samples.

Networks of heights above the ground get levelled clouds, and their boxes are put back on the ground. The published
networks were trained in CARLA's left-handed LiDAR frame, y to the right, on intensities of 8 bits. Samples and
detections are right-handed everywhere: such a network gets the mirror image, and its boxes are mirrored back.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from dsrc.data.level import joined, level, raised
from dsrc.data.sample import Sample, inside
from dsrc.models.inputs.lone_points import without_lone_points
from dsrc.models.settings import ModelSettings
from dsrc.ops.detections import Detections
from sim.boxes import Boxes

_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def as_trained(sample: Sample, settings: ModelSettings) -> Sample:
    """Return a sample as a network of these settings was trained to see it, itself if that is how samples are."""
    sample = on_its_ground(sample, settings)
    if not settings.left_handed and settings.intensity_steps is None:
        return sample
    clouds, others, corrupted = (
        tuple(_cloud(cloud, settings) for cloud in clouds)
        for clouds in (sample.clouds, sample.other_clouds, sample.corrupted)
    )
    seen = replace(sample, clouds=clouds, other_clouds=others, corrupted=corrupted)
    if not settings.left_handed:
        return seen
    return replace(
        seen,
        ego_from_agent=_MIRROR @ sample.ego_from_agent @ _MIRROR,
        boxes=mirrored(sample.boxes),
        agent_boxes=tuple(mirrored(boxes) for boxes in sample.agent_boxes),
        lost=tuple(np.ascontiguousarray(tiles[::-1]) for tiles in sample.lost),
    )


def prepared(sample: Sample, settings: ModelSettings) -> Sample:
    """Return a sample as its agents prepare it for a network of these settings, once: without lone points, levelled."""
    return on_its_ground(without_lone_points(sample) if settings.drop_lone_points else sample, settings)


def on_its_ground(sample: Sample, settings: ModelSettings) -> Sample:
    """Return a sample levelled for a network of heights above the ground; itself for others, or where it is level."""
    if settings.height == "sensor":
        return sample
    return level(sample, settings.grid)


def as_sensed(found: Detections, sample: Sample, settings: ModelSettings) -> Detections:
    """Return detections in a sample of `prepared` at the sensors' heights, in the range that counts."""
    if settings.height == "sensor":
        return found
    boxes = raised(found.boxes, joined(sample.grounds[: 1 if settings.fusion == "none" else settings.max_agents]))
    return Detections(boxes, found.score)[inside(boxes, settings.request.judged_m)]


def mirrored(boxes: Boxes) -> Boxes:
    """Return boxes in the frame whose y axis points to the other side; twice, they are the same bit for bit."""
    center = boxes.center * [1.0, -1.0, 1.0]
    return replace(boxes, center=center, yaw=np.where(boxes.yaw == np.pi, np.pi, -boxes.yaw))


def _cloud(cloud: NDArray[np.float32], settings: ModelSettings) -> NDArray[np.float32]:
    """Return a (P, 4) cloud, mirrored and with rounded intensities as the settings say."""
    seen = cloud.copy()
    if settings.left_handed:
        seen[:, 1] *= -1
    if settings.intensity_steps is not None:
        steps = np.float32(settings.intensity_steps)
        # Not clipped: corruptions of the paper leave [0, 1] after the rounding, in the sensor's driver.
        seen[:, 3] = np.round(cloud[:, 3] * steps) / steps
    return seen
