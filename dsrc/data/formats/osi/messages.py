"""Messages of a frame: ground truth, and per agent a sensor view and the objects that its LiDAR meets.

    ground_truth        GroundTruth    all road users in the world
    sensor_view/ID      SensorView     the ground truth, the agent as host, and its LiDAR's mounting
    sensor_data/ID      SensorData     road users with a point of the agent, in the frame of its LiDAR

The origin of a vehicle is the middle of its footprint: `bbcenter_to_rear` points there. A roadside unit is no object,
so its host is left out and its mounting is its pose in the world. OSI's frames and angles are ours: x forward, y left,
z up, pitch lowers the front.

Source: ASAM Open Simulation Interface 3.8.0: osi_groundtruth, osi_sensorview, osi_sensordata, osi_detectedobject.
"""

import warnings
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sensors.frame import Frame
from sim.boxes import CLASSES, tilted_poses
from sim.errors import SettingsError
from sim.geometry import invert, pose_angles
from sim.traffic.base import SIGNALS

_TYPES = {
    "car": "CAR",
    "van": "DELIVERY_VAN",
    "truck": "HEAVY_TRUCK",
    "bus": "BUS",
    "motorcycle": "MOTORBIKE",
    "bicycle": "BICYCLE",
}
"""Types of vehicles by our classes; a pedestrian is an object of its own kind."""


def load_osi() -> Any:
    """Return the package betterosi; SettingsError where it is missing."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            import betterosi
    except ImportError:
        hint = "pip install 'dsrc-testbed[osi]'"
        raise SettingsError(f"osi: expected the package betterosi, found none; {hint}") from None
    return betterosi


def messages_of(frame: Frame) -> Iterator[tuple[str, Any]]:
    """Yield the messages of a frame with the names of their channels.

    Raises:
        SettingsError: the package is missing.
    """
    osi = load_osi()
    truth = osi.GroundTruth(
        **_head(frame), moving_object=[_object(frame, row) for row in range(len(frame.truth))], **_host(frame, 0)
    )
    yield "ground_truth", truth
    for row, agent in enumerate(frame.agents):
        sensor_id = osi.Identifier(value=row)
        mounting = _mounting(frame, row)
        view = osi.LidarSensorView(
            view_configuration=osi.LidarSensorViewConfiguration(sensor_id=sensor_id, mounting_position=mounting)
        )
        common = {**_head(frame), "sensor_id": sensor_id, "mounting_position": mounting}
        yield (
            f"sensor_view/{agent.agent_id}",
            osi.SensorView(**common, global_ground_truth=truth, lidar_sensor_view=[view], **_host(frame, row)),
        )
        met = np.flatnonzero(frame.points_on[row] > 0).tolist()
        yield (
            f"sensor_data/{agent.agent_id}",
            osi.SensorData(**common, moving_object=[_detected(frame, row, other) for other in met]),
        )


def _head(frame: Frame) -> dict[str, Any]:
    osi = load_osi()
    seconds, nanos = divmod(round(frame.time_s * 1e9), 10**9)
    return {
        "version": osi.InterfaceVersion(version_major=3, version_minor=8, version_patch=0),
        "timestamp": osi.Timestamp(seconds=seconds, nanos=nanos),
    }


def _host(frame: Frame, row: int) -> dict[str, Any]:
    """Return the field of the host vehicle, where the agent is one."""
    agent_id = frame.agents[row].agent_id if frame.agents else -1
    return {} if agent_id < 0 else {"host_vehicle_id": load_osi().Identifier(value=agent_id)}


def _vector(xyz: NDArray[np.float64]) -> Any:
    return load_osi().Vector3D(**dict(zip("xyz", map(float, xyz), strict=True)))


def _turn(pose: NDArray[np.float64]) -> Any:
    yaw, pitch, roll = map(float, pose_angles(pose))
    return load_osi().Orientation3D(roll=roll, pitch=pitch, yaw=yaw)


def _base(pose: NDArray[np.float64], size: NDArray[np.float64], motion: dict[str, NDArray[np.float64]]) -> Any:
    """Return pose, size and those of the vectors of motion that are known."""
    osi = load_osi()
    length, width, height = map(float, size)
    return osi.BaseMoving(
        dimension=osi.Dimension3D(length=length, width=width, height=height),
        position=_vector(pose[:3, 3]),
        orientation=_turn(pose),
        **{name: _vector(value) for name, value in motion.items() if np.isfinite(value).all()},
    )


def _kind(frame: Frame, row: int) -> dict[str, Any]:
    """Return type and classification of an object; lights that are off may also be unknown, and are left out."""
    kinds = load_osi().MovingObject
    name = CLASSES[frame.truth.label[row]]
    if name == "pedestrian":
        return {"type": kinds.Type.PEDESTRIAN}
    lit, light = int(frame.signals[row]), kinds.VehicleClassification.LightState
    indicators = {"hazard lights": "WARNING", "right indicator": "RIGHT", "left indicator": "LEFT"}
    on: dict[str, Any] = {}
    if lit & SIGNALS["brake light"]:
        on["brake_light_state"] = light.BrakeLightState.NORMAL
    for signal, state in indicators.items():
        if lit & SIGNALS[signal] and "indicator_state" not in on:
            on["indicator_state"] = light.IndicatorState[state]
    vehicle = kinds.VehicleClassification(
        type=kinds.VehicleClassification.Type[_TYPES[name]], **({"light_state": light(**on)} if on else {})
    )
    return {"type": kinds.Type.VEHICLE, "vehicle_classification": vehicle}


def _object(frame: Frame, row: int) -> Any:
    osi, boxes = load_osi(), frame.truth
    kind = _kind(frame, row)
    if "vehicle_classification" in kind:
        down = np.array([0.0, 0.0, -0.5 * boxes.size[row, 2]])
        kind["vehicle_attributes"] = osi.MovingObject.VehicleAttributes(bbcenter_to_rear=_vector(down))
    motion = {"velocity": np.append(frame.velocity[row], 0.0), "acceleration": np.append(frame.acceleration[row], 0.0)}
    return osi.MovingObject(
        id=osi.Identifier(value=int(boxes.object_id[row])),
        base=_base(tilted_poses(boxes[row : row + 1], frame.tilt[row])[0], boxes.size[row], motion),
        **kind,
    )


def _mounting(frame: Frame, row: int) -> Any:
    osi, agent = load_osi(), frame.agents[row]
    pose = agent.sweep.world_from_lidar
    if agent.agent_id >= 0:
        pose = invert(agent.world_from_body) @ pose
    return osi.MountingPosition(position=_vector(pose[:3, 3]), orientation=_turn(pose))


def _detected(frame: Frame, row: int, other: int) -> Any:
    """Return an object as an agent's LiDAR meets it: pose in the LiDAR's frame, motion relative to its vehicle's."""
    osi, boxes, agent = load_osi(), frame.truth, frame.agents[row]
    lidar_from_world = invert(agent.sweep.world_from_lidar)
    pose = lidar_from_world @ tilted_poses(boxes[other : other + 1], frame.tilt[other])[0]
    own = np.flatnonzero(boxes.object_id == agent.agent_id)
    velocity = frame.velocity[other] - (frame.velocity[own[0]] if len(own) else 0.0)
    turned = lidar_from_world[:3, :2] @ velocity
    number = osi.Identifier(value=int(boxes.object_id[other]))
    kind = _kind(frame, other)
    state = osi.DetectedItemHeader.MeasurementState.MEASURED
    return osi.DetectedMovingObject(
        header=osi.DetectedItemHeader(
            tracking_id=number, ground_truth_id=[number], existence_probability=1.0, measurement_state=state
        ),
        base=_base(pose, boxes.size[other], {"velocity": turned}),
        candidate=[osi.DetectedMovingObject.CandidateMovingObject(probability=1.0, **kind)],
    )
