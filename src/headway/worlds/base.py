"""The laws of an environment in NumPy, for one or many copies of it alike."""

import math
import numbers
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np

from headway.errors import ConfigError, check_names
from headway.sim_params import SimParamSets
from headway.task import EnvSpec

SimParams = dict[str, float]


class World:
    """The laws of one environment.

    Functions of states, observations and rewards work on arrays with any number of leading
    axes, so that stepping one environment and stepping many are the same arithmetic.

    Args:
        sim_params: Replaces the spec's training and unseen physics.
        **options: Options of the Task.

    Raises:
        UnknownNameError: An option is unknown.
        ConfigError: A parameter is unknown or a value not allowed.
    """

    spec: ClassVar[EnvSpec]
    obs_dtype: ClassVar[type[np.floating]]
    choices: ClassVar[Mapping[str, tuple[float, ...]]] = {}
    """Allowed values of the parameters that take only some."""
    signed: ClassVar[tuple[str, ...]] = ()
    """Parameters that may be 0 or negative; all others are positive."""
    obs_bounds: ClassVar[float | tuple[float, ...]] = math.inf
    """Largest absolute values of an observation."""
    time_step: float
    """Seconds between two observations."""

    def __init__(self, sim_params: SimParamSets | None = None, **options: bool):
        check_names(f"{self.spec.name} option", options, self.spec.options)
        self.task: Any = self.spec.make_task(**options)  # options are its fields
        self.sim_params = sim_params or self.spec.sim_params
        for group in self.sim_params.group_names:
            for values in self.sim_params.group(group):
                self.check(values)

    def check(self, values: Mapping[str, Any]) -> SimParams:
        """Return simulator parameters as floats.

        Raises:
            ConfigError: A name is unknown or a value not allowed.
        """
        checked = {}
        check_names(f"{self.spec.name} sim_param", values, self.spec.default_sim_params)
        for name, value in values.items():
            number = float(value) if isinstance(value, numbers.Real) else math.nan
            choices, positive = self.choices.get(name), name not in self.signed
            least = 0.0 if positive else -math.inf
            if not (number in choices if choices else least < number < math.inf):
                allowed = "finite numbers" + " above 0" * positive
                allowed = ", ".join(map(str, choices)) if choices else allowed
                raise ConfigError(
                    f"{self.spec.name} sim_params {name} is {value!r}, allowed: {allowed}."
                )
            checked[name] = number
        return checked
