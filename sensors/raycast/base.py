"""Interface of the ray-casting engines: scene, request, returns and the definition of a measurement."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from sensors.motion import Path
from sensors.optics.beams import Beams
from sensors.optics.noise import SweepNoise
from sensors.optics.reflectance import Optics
from sensors.spec import LidarSpec
from sim.rows import Rows


class EngineUnavailable(Exception):
    """Engine that cannot run on this machine; the message gives the reason."""


@dataclass(frozen=True, slots=True, eq=False, weakref_slot=True)
class Solid:
    """Rigid triangle mesh. Engines build one hierarchy per solid and recognise it by identity.

    Attributes:
        vertices: (V, 3) float32 relative to `origin`, m: Embree computes in float32, exact only near the origin.
        faces: (F, 3) int32 rows of `vertices`.
        material: (F,) uint8 index into `sim.mesh.materials.MATERIALS`.
        origin: (3,) float64 in the solid's own frame: the world's for the static world, the body's for a body.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    material: NDArray[np.uint8]
    origin: NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))


@dataclass(frozen=True, slots=True, eq=False)
class Bodies(Rows):
    """The N moving actors of one instant: ids, sizes, solids and paths.

    Attributes:
        object_id: (N,) int64 ascending.
        size: (N, 3) length, width and height of the box that holds the solid; it stands on the body frame's z = 0.
        solids: N solids in their body frames, their origins zero.
        path: world_from_body over the span.
        span_s: first and last instant of the sweeps, s.
    """

    SHARED: ClassVar = ("span_s",)

    object_id: NDArray[np.int64]
    size: NDArray[np.float64]
    solids: tuple[Solid, ...]
    path: Path
    span_s: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class SweepRequest:
    """Request of one sweep: sensor, rays, noise and poses.

    Attributes:
        spec: the sensor.
        beams: its rays, B blocks of columns.
        optics: its tables of power, detection and intensity.
        noise: its random numbers.
        knots: (B + 1, 3, 4) float64 world_from_lidar at the start of columns 0, 16, 32, ...; poses are interpolated
            linearly.
        pose: (4, 4) float64 world_from_lidar at the reference time: the frame of the points.
        time_s: reference time; column c of ring r fires at `time_s + spec.time_offset[r, c]`.
        hidden_id: object that this sensor does not see, or None.
    """

    spec: LidarSpec
    beams: Beams
    optics: Optics
    noise: SweepNoise
    knots: NDArray[np.float64]
    pose: NDArray[np.float64]
    time_s: float
    hidden_id: int | None


class Returns(NamedTuple):
    """The P points of one sweep, ring by ring from the top, columns ascending, the nearer return first.

    The columns are those of `sensors.sweep.Sweep`.
    """

    points: NDArray[np.float32]
    intensity: NDArray[np.float32]
    ring: NDArray[np.int16]
    column: NDArray[np.int32]
    time_offset: NDArray[np.float32]
    object_id: NDArray[np.int32]
    return_number: NDArray[np.uint8]
    material: NDArray[np.uint8]
    cosine: NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class Hits:
    """First hits of N single rays.

    Attributes:
        distance: (N,) float32 in units of the direction's length, m for unit directions; the reach where missed.
        face: (N,) int32 row of the triangle, -1 where missed.
        cosine: (N,) float32 |cos| of the angle between the ray and the triangle's normal, 0 where missed.
    """

    distance: NDArray[np.float32]
    face: NDArray[np.int32]
    cosine: NDArray[np.float32]


class Engine(Protocol):
    """Ray-casting engine: sweeps and single rays. All engines follow this definition and give the same points.

    Of beam (r, c), with the poses of its block interpolated at its firing:

    1. Each sub-ray finds the nearest surface of the static world and of all bodies but the hidden one, where they are
       when it fires, within the beam's farthest range (`beams.reach[r, 1]`); both sides of a triangle are solid.
       With `spec.angle_noise_deg` all sub-rays of a beam are tilted by the same two random angles.
    2. A sub-ray that hit has power `optics.power[material, cosine]` and margin power / `optics.need[distance]`, each
       divided by S, the number of sub-rays. Without power, as from a pane that mirrors it away, it is no hit.
    3. Hits of one beam, ordered by distance, belong to one echo while the next is at most `optics.gate_m` farther. An
       echo's power and margin are the sums of its rays'; its distance is their mean, weighted by the margins; object,
       material and cosine are those of the ray with the largest margin, the first of equal ones.
    4. An echo is detected if its margin is at least 1. Of the detected echoes `spec.returns` are reported: the one
       with the largest margin (the nearest of equal ones); the farthest; or both, and if they are the same one, the
       one with the second largest margin beside it.
    5. Measured range = distance + `spec.range_noise_m` times normal number `RANGE` (`SECOND_RANGE` for the second of
       two reported). Intensity = min(1, power * `optics.scale[distance]`), without `of_material` the scale alone.
    6. Lost: every return of a beam whose uniform number `LOST_BEFORE` is below `spec.dropoff_rate`, a return whose
       number `LOST_AFTER` is below the chance that `drop_chance` gives its intensity, and returns whose distance or
       measured range is below `beams.reach[r, 0]` or whose measured range is beyond `beams.reach[r, 1]`.
    7. The point lies at the measured range along `beams.axis` from the sensor's place at the firing, expressed in the
       sensor frame at the reference time.
    """

    name: str

    def cast(
        self,
        solid: Solid,
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        reach: NDArray[np.float32],
    ) -> Hits:
        """Cast N single rays against one solid.

        Args:
            origins: (N, 3) m, relative to `solid.origin`.
            directions: (N, 3) unit vectors; zero or NaN directions miss.
            reach: (N,) farthest distance, m; not changed.
        """
        ...

    def cast_each(
        self,
        solids: Sequence[Solid],
        counts: Sequence[int],
        origins: NDArray[np.float32],
        directions: NDArray[np.float32],
        reach: NDArray[np.float32],
    ) -> Hits:
        """Cast N single rays at several solids, the first `counts[0]` at the first alone and so on, as `cast`."""
        ...

    def sweep(self, static: Solid, bodies: Bodies, requests: Sequence[SweepRequest], threads: int) -> list[Returns]:
        """Return the sweeps of one instant, in order; the number of threads changes no byte."""
        ...
