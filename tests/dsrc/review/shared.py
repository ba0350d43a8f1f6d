"""Shares in the first frame of the street: each agent finds a car, one makes a ghost, one harms, a car is missed."""

import msgspec

from dsrc.evaluation.sharing.stored import SharedBox, SharedFrame, StoredShares
from sim.geometry import invert
from tests.dsrc.review.conftest import street_frame

EGO, HELPER, POLE = 1000, 1002, -1
GHOST = SharedBox(
    object_id=-1,
    box=(10.0, -25.0, -1.0, 4.0, 2.0, 1.5, 0.3),
    team=0.4,
    share={HELPER: 0.3, EGO: 0.1},
    without={HELPER: 0.1, EGO: 0.4},
)
"""The ghost of `FakeDetector`."""


def shared_street() -> StoredShares:
    """Shares in the first frame, clean and in fog 2."""
    frame = street_frame(0)
    truth = frame.truth.transform(invert(frame.agent(EGO).sweep.world_from_lidar))

    def box(object_id: int, share: dict[int, float], without: dict[int, float]) -> SharedBox:
        place = truth.array[truth.object_id == object_id][0]
        return SharedBox(object_id, tuple(place.tolist()), sum(share.values()), share, without)

    boxes = (
        box(1001, {-1: 0.1, EGO: 0.6, HELPER: 0.1}, {-1: 0.7, EGO: 0.8, HELPER: 0.7}),
        box(1003, {-1: 0.0, EGO: 0.0, HELPER: 0.9}, {-1: 0.9, EGO: 0.9, HELPER: 0.0}),
        box(1004, {-1: 0.4, EGO: 0.3, HELPER: -0.2}, {-1: 0.1, EGO: 0.5, HELPER: 0.7}),
        box(1005, {-1: 0.0, EGO: 0.0, HELPER: 0.0}, {-1: 0.0, EGO: 0.0, HELPER: 0.0}),
        GHOST,
    )
    frames = [SharedFrame("street", kind, 0, EGO, boxes) for kind in ("clean", "fog")]
    made = {"settings": {"severity": 2, "family": "physical", "seed": 0}}
    content = {"provenance": made, "drives": [], "frames": msgspec.to_builtins(frames)}
    return msgspec.convert(content, StoredShares)
