"""Results of a campaign, made up by hand."""

from typing import Any

from dsrc.closed_loop.campaign.episode import EpisodeResult
from dsrc.closed_loop.campaign.plan import Campaign, PerceptionSpec

PLAN = Campaign(
    scenarios=("ima_building",),
    perceptions=(
        PerceptionSpec(name="truth"),
        PerceptionSpec(name="alone", uses="ego"),
        PerceptionSpec(name="together", uses="team"),
    ),
    corruption=("clean", "fog", "snow"),
)


def one(perception: str, seed: int, outcome: str, corruption: str = "clean", **more: Any) -> EpisodeResult:
    metrics = {"collision": float(outcome == "crashed"), "completion": 1.0, "driving_score_2_1": 1.0}
    return EpisodeResult(
        scenario="ima_building",
        perception=perception,
        corruption=corruption,
        severity=0 if corruption == "clean" else 3,
        family="",
        who="all",
        channel="ideal",
        seed=seed,
        road_user=more.pop("road_user", "car"),
        detectable=True,
        outcome=outcome,
        message="",
        key="",
        metrics=metrics | more,
    )


RESULTS = [
    *(one("truth", seed, "arrived") for seed in range(3)),
    *(one("alone", seed, "crashed") for seed in range(3)),
    *(one("together", seed, "arrived") for seed in range(2)),
    one("together", 2, "desynchronised"),
    *(one(name, seed, "timeout", kind) for name in ("alone",) for seed in range(2) for kind in ("fog", "snow")),
    *(one("together", seed, "arrived", kind) for seed in range(2) for kind in ("fog", "snow")),
]
