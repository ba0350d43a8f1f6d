"""Gymnasium environments of the closed loop: `dsrc/Rail-v0`, `dsrc/Meta-v0`, `dsrc/Free-v0`."""

from gymnasium.envs.registration import register, registry

SPEEDS_MPS = (0.0, 5.0, 10.0, 15.0, 20.0, 25.0, 30.0)
"""Speeds between which the actions of `dsrc/Meta-v0` choose; highway-env's own begin at 20 m/s."""
ENVIRONMENTS = {
    "dsrc/Rail-v0": {"type": "ContinuousAction", "longitudinal": True, "lateral": False},
    "dsrc/Meta-v0": {
        "type": "DiscreteMetaAction",
        "longitudinal": True,
        "lateral": False,
        "target_speeds": list(SPEEDS_MPS),
    },
    "dsrc/Free-v0": {"type": "ContinuousAction", "longitudinal": True, "lateral": True},
}
"""Actions by id; other settings are those of `DrivingEnv.default_config`."""


def register_environments() -> None:
    """Register the ids with gymnasium; a second call changes nothing."""
    for name, action in ENVIRONMENTS.items():
        if name not in registry:
            entry = "dsrc.closed_loop.environments.driving:DrivingEnv"
            register(name, entry_point=entry, kwargs={"action": action})


register_environments()
