"""Door of PettingZoo, which the extra `pettingzoo` installs."""

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from dsrc.closed_loop.environments import ENVIRONMENTS
from sim.errors import SettingsError, complaint

if TYPE_CHECKING:
    from dsrc.closed_loop.environments.team import TeamEnv


def parallel_env(
    scenario: Any = "four_way",
    egos: int = 3,
    perception: str | Sequence[Any] = "truth",
    action: dict[str, object] | None = None,
    **settings: Any,
) -> "TeamEnv":
    """Return several egos in one traffic as an environment of PettingZoo's parallel API.

    Agents are `ego_0`, which a single ego would be, and the vehicles nearest to it, or those that the scenario names.
    With a perception that has helpers, such as `team`, they are each other's.

    Args:
        scenario: name, path or struct.
        egos: number of them.
        perception: of all, or one of each; texts as `dsrc.open_perception` takes them, or objects.
        action: highway-env's settings of the action; default: the acceleration, as in `dsrc/Rail-v0`.
        settings: others of `dsrc.DrivingEnv.default_config`, such as `duration=10.0`.

    Raises:
        SettingsError: PettingZoo is not installed, or a setting is wrong.
    """
    try:
        from dsrc.closed_loop.environments.team import TeamEnv
    except ModuleNotFoundError as error:
        if error.name != "pettingzoo":
            raise
        expected = "PettingZoo: pip install 'dsrc-testbed[pettingzoo]'"
        raise SettingsError(complaint("environment", "parallel_env", expected, "none")) from None
    return TeamEnv(scenario, egos, perception, action or ENVIRONMENTS["dsrc/Rail-v0"], **settings)
