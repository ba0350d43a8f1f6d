"""Settings of the tracker: motion and noise by kind of road user, association, life cycle."""

import msgspec


class Motion(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Motion of one kind of road user and errors of its detections.

    Attributes:
        position_m: standard deviation of a detected centre along each axis of the box, m.
        length_error: further deviation along the box, as a share of its length: the far end is often unseen.
        yaw_rad: standard deviation of a detected heading, rad.
        speed_mps: standard deviation of the unknown speed of a new track along its box, m/s.
        sideways_mps: the same across its box, m/s.
        acceleration: square root of the spectral density of the acceleration along the box, m/s^1.5.
        sideways_acceleration: the same across the box, m/s^1.5.
        turning: square root of the spectral density of the heading beside its turn rate, rad/s^0.5.
        curvature_per_m: standard deviation of the curvature of a slow path, 1/m; 0: constant velocity.
        lateral_mps2: standard deviation of the lateral acceleration, which bounds the turn rate of a fast path, m/s2.
        slip_mps: standard deviation of the velocity across the box, m/s; None: it moves in any direction.
        slip_rad: further deviation of the direction of motion from the heading, rad.
    """

    position_m: float = 0.2
    length_error: float = 0.03
    yaw_rad: float = 0.1
    speed_mps: float = 15.0
    sideways_mps: float = 3.0
    acceleration: float = 0.8
    sideways_acceleration: float = 0.3
    turning: float = 0.05
    curvature_per_m: float = 0.1
    lateral_mps2: float = 2.0
    slip_mps: float | None = 0.2
    slip_rad: float = 0.05


VEHICLE = Motion()
"""Cars, vans, trucks and buses."""
TWO_WHEELER = Motion(
    length_error=0.0,
    yaw_rad=0.5,
    speed_mps=8.0,
    sideways_acceleration=0.7,
    turning=0.5,
    slip_mps=None,
)
"""Motorcycles and bicycles, and pedestrians whom a detector takes for them: these step sideways, so no direction is
excluded."""
PEDESTRIAN = Motion(
    length_error=0.0,
    yaw_rad=0.5,
    speed_mps=2.0,
    sideways_mps=2.0,
    acceleration=0.7,
    sideways_acceleration=0.7,
    turning=0.5,
    curvature_per_m=0.0,
    slip_mps=None,
)
"""Pedestrians: constant velocity in any direction."""


class TrackerSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the tracker.

    Attributes:
        vehicle: motion of cars, vans, trucks and buses.
        two_wheeler: motion of motorcycles and bicycles.
        pedestrian: motion of pedestrians.
        reported_position_m: deviation of the centre of a box whose velocity is measured: its owner reports it, m.
        reported_yaw_rad: deviation of its heading, rad.
        reported_velocity_mps: deviation of its velocity along each axis, m/s.
        manoeuvre: growth of the density of the acceleration per standard deviation by which the running mean of the
            residuals along the box exceeds 1: a road user that brakes is followed, one that stands stays still.
        push_gain: weight of a residual in that mean, 0 to 1.
        turn_time_s: correlation time of the turn rate, s.
        gate: largest Mahalanobis distance of a detection from a track, standard deviations.
        score_cost: cost of a detection of score 0 above one of score 1, squared standard deviations.
        overlap: footprint IoU from which on two boxes of one group, vehicles or others, are one object; two others are
            one also where the centre of one lies in the other.
        direction_mps: speed from which on the motion decides the heading, m/s.
        smoothing: weight of a detection in the size and height of a track, 0 to 1.
        start_score: lowest score of a detection that starts a track.
        even_score: detection score that is evidence neither for a road user nor for a ghost. Of 60,000 boxes of two
            detectors in nine encounters, clean and in fog, snow and crosstalk, 13 % of those with scores of 0.20 to
            0.25 are of road users, 64 % of those of 0.4 to 0.5, and 98 % of those of 0.6 to 0.7.
        score_evidence: evidence of a box per unit of detection score above that.
        ghosts_per_m2: density of ghosts that a box is compared with, 1/m2; fitted.
        sure_score: score of the first box of a track that can confirm it alone; others need a second, for a velocity.
        missed_evidence: loss of evidence with each percept that has no box of the track, at any rate of percepts.
        confirm_evidence: evidence that confirms a track.
        refute_evidence: evidence below which a confirmed track ends.
        least_evidence: lower bound of the evidence.
        most_evidence: upper bound: a long history must not outweigh what is seen now.
        score_gain: weight of a detection in the score of a track, 0 to 1.
        half_life_s: time in which the score of an unseen confirmed track halves, s.
        tentative_half_life_s: the same of a tentative track, s.
        drop_score: score below which a track ends.
        forget_s: longest time without a detection, s, even where no percept arrives.
        history_s: age up to which a percept that arrives out of order still counts, s.
    """

    vehicle: Motion = VEHICLE
    two_wheeler: Motion = TWO_WHEELER
    pedestrian: Motion = PEDESTRIAN
    reported_position_m: float = 0.02
    reported_yaw_rad: float = 0.01
    reported_velocity_mps: float = 0.05
    manoeuvre: float = 25.0
    push_gain: float = 0.4
    turn_time_s: float = 4.0
    gate: float = 3.5
    score_cost: float = 1.0
    overlap: float = 0.2
    direction_mps: float = 2.0
    smoothing: float = 0.2
    start_score: float = 0.1
    even_score: float = 0.4
    score_evidence: float = 12.0
    ghosts_per_m2: float = 0.01
    sure_score: float = 0.8
    missed_evidence: float = 0.7
    confirm_evidence: float = 0.0
    refute_evidence: float = -1.0
    least_evidence: float = -4.0
    most_evidence: float = 8.0
    score_gain: float = 0.3
    half_life_s: float = 0.3
    tentative_half_life_s: float = 0.1
    drop_score: float = 0.05
    forget_s: float = 3.0
    history_s: float = 0.5

    def __post_init__(self) -> None:
        if not self.ghosts_per_m2 > 0.0:
            raise ValueError(f"ghosts_per_m2: expected more than 0, found {self.ghosts_per_m2:g}")
        bounds = self.least_evidence, self.refute_evidence, self.confirm_evidence, self.most_evidence
        if not (bounds[0] <= bounds[1] < bounds[2] <= bounds[3]):
            found = ", ".join(f"{bound:g}" for bound in bounds)
            raise ValueError(f"evidence: expected least <= refute < confirm <= most, found {found}")
