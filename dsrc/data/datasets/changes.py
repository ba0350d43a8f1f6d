"""Changes of a recorded drive's sensors: the options of `dsrc dataset render`."""

import msgspec


class Changes(msgspec.Struct, frozen=True, kw_only=True):
    """Sensors and agents of a rendered drive that differ from the recording.

    Attributes:
        lidar: preset of the vehicles' LiDARs, such as vlp-16; default: the recording's.
        roadside_lidar: preset of the roadside units' LiDARs; default: the recording's.
        roadside: keep the roadside units.
        vehicles: number of vehicles with a LiDAR; default: the recording's.
        agent_id: ids of the vehicles with a LiDAR, ego first; default: the recording's.
        mount: x y z in the body frame, m, and pitch, deg, of the vehicles' LiDARs; default: the recording's.
        frames: frames of each drive, from the first; default: all.
    """

    lidar: str | None = None
    roadside_lidar: str | None = None
    roadside: bool = True
    vehicles: int | None = None
    agent_id: tuple[int, ...] = ()
    mount: tuple[float, float, float, float] | None = None
    frames: int | None = None
