"""Gymnasium environments of the closed loop: `dsrc/Rail-v0`, `dsrc/Meta-v0`, `dsrc/Free-v0`."""

from gymnasium.envs.registration import register, registry

ENVIRONMENTS = {
    "dsrc/Rail-v0": {"action": {"type": "ContinuousAction", "longitudinal": True, "lateral": False}},
    "dsrc/Meta-v0": {"action": {"type": "DiscreteMetaAction", "longitudinal": True, "lateral": False}},
    "dsrc/Free-v0": {"action": {"type": "ContinuousAction", "longitudinal": True, "lateral": True}},
}
"""Configurations by id; other settings are those of `DrivingEnv.default_config`."""


def register_environments() -> None:
    """Register the ids with gymnasium; a second call changes nothing."""
    for name, config in ENVIRONMENTS.items():
        if name not in registry:
            entry = "dsrc.closed_loop.environments.driving:DrivingEnv"
            register(name, entry_point=entry, kwargs={"config": config})


register_environments()
