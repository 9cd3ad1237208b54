"""Physics that change during an episode: which simulator parameters from which step on."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from headway.errors import ConfigError

Schedule = Mapping[int, Mapping[str, float]]
"""New simulator parameters by the step before which they come into force; 0 is the first."""

Check = Callable[[dict[str, Any]], dict[str, float]]


def read_schedule(value: Any, check: Check) -> dict[int, dict[str, float]]:
    """Check the schedule of one episode.

    Args:
        value: New simulator parameters by step, or None.
        check: Refuses simulator parameters that the environment does not have.

    Raises:
        ConfigError: It is no mapping, a step is no number, or a parameter is not allowed.
    """
    if not isinstance(value, Mapping | None):
        raise ConfigError(
            f"schedule is {value!r}, allowed: simulator parameters by step, for example"
            " {100: {'mass_scale': 2.0}}."
        )
    found = {}
    for step, sim_params in (value or {}).items():
        if isinstance(step, bool) or not isinstance(step, int) or step < 0:
            raise ConfigError(f"schedule has a step {step!r}, allowed: whole numbers from 0.")
        if not isinstance(sim_params, Mapping):
            raise ConfigError(
                f"schedule step {step} is {sim_params!r}, allowed: values by parameter name."
            )
        found[step] = check(dict(sim_params))
    return found


def read_schedules(value: Any, num_envs: int, check: Check) -> list[dict[int, dict[str, float]]]:
    """Check the schedules of many environments: one for all, or a sequence of one for each.

    Raises:
        ConfigError: As `read_schedule`, or there are more or fewer of them than environments.
    """
    if value is None or isinstance(value, Mapping):
        return [read_schedule(value, check)] * num_envs
    if not isinstance(value, Sequence) or len(value) != num_envs:
        raise ConfigError(
            f"schedule is {value!r}, allowed: one mapping, or {num_envs} of them, one per"
            " environment."
        )
    return [read_schedule(one, check) for one in value]
