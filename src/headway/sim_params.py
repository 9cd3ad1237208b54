"""Simulator parameters: the hidden physics of an environment, and the sets they come from."""

import dataclasses
import itertools
import math
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from headway.errors import ConfigError, shown, unknown_name

Values = Mapping[str, tuple[float, ...]]

MAX_COMBINATIONS = 100_000
"""Physics that one group may stand for."""


@dataclasses.dataclass(frozen=True)
class SimParamSets:
    """The physics to train on, and groups of physics kept for testing.

    Values of different parameters are independent: a set stands for all their combinations.

    Example:
        >>> sets = SimParamSets({"length": (0.5, 1.0)}, {"long": {"length": (1.5,)}})
        >>> sets.group_names
        ('train', 'long')
        >>> sets.group("train")
        [{'length': 0.5}, {'length': 1.0}]

    Raises:
        ConfigError: A part is missing, unknown, of the wrong type, or no finite number.
    """

    train: Values
    """Values of each parameter during training."""
    unseen: Mapping[str, Values] = dataclasses.field(default_factory=dict)
    """Values of each parameter in each group of test physics, by the group's name."""

    def __post_init__(self) -> None:
        if not isinstance(self.unseen, Mapping):
            raise ConfigError(
                f"sim_params unseen is {shown(self.unseen)}, allowed: parameter values by"
                " group name."
            )
        _check_values("train", self.train)
        for name, values in self.unseen.items():
            if name == "train" or not isinstance(name, str):
                raise ConfigError(
                    f"sim_params unseen has a group {shown(name)}, allowed: names other than"
                    " 'train'."
                )
            _check_values(f"unseen group {shown(name)}", values)
            if set(values) != set(self.train):
                raise ConfigError(
                    f"sim_params unseen group {name!r} has {', '.join(map(str, values))}, allowed:"
                    f" a value for every parameter of train, {', '.join(self.train)}."
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.train)

    @property
    def group_names(self) -> tuple[str, ...]:
        """`"train"`, then the unseen groups."""
        return ("train", *self.unseen)

    def sample(self, rng: np.random.Generator) -> dict[str, float]:
        """Draw each parameter uniformly and independently from its training values."""
        return {
            name: float(values[rng.integers(len(values))]) for name, values in self.train.items()
        }

    def group(self, name: str) -> list[dict[str, float]]:
        """Return every combination of a group's values.

        Raises:
            UnknownNameError: There is no such group.
        """
        values = self._values(name)
        combinations = itertools.product(*values.values())
        return [dict(zip(values, map(float, chosen), strict=True)) for chosen in combinations]

    def spread(self, name: str, count: int) -> list[dict[str, float]]:
        """Return so many physics of a group, with every value of a parameter equally often.

        All combinations in turn if there are not more than `count`. Else a Latin hypercube:
        each parameter goes evenly through its values, in an order of its own that is always the
        same.

        Raises:
            UnknownNameError: There is no such group.
        """
        combinations = self.group(name)
        if count >= len(combinations):
            return [combinations[i % len(combinations)] for i in range(count)]
        rng = np.random.default_rng(0)
        columns = {
            parameter: np.array(numbers)[rng.permutation(np.arange(count) * len(numbers) // count)]
            for parameter, numbers in self._values(name).items()
        }
        return [{key: float(column[i]) for key, column in columns.items()} for i in range(count)]

    def _values(self, name: str) -> Values:
        if name not in self.group_names:
            raise unknown_name("group", name, self.group_names)
        return self.train if name == "train" else self.unseen[name]

    def to_dict(self) -> dict[str, Any]:
        """Return plain dictionaries and lists, ready for JSON."""
        lists = {
            group: {
                key: [float(x) for x in numbers] for key, numbers in self._values(group).items()
            }
            for group in self.group_names
        }
        return {"train": lists.pop("train"), "unseen": lists}

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "SimParamSets":
        """Rebuild what `to_dict` wrote.

        Raises:
            ConfigError: A part is missing, unknown, of the wrong type, or no finite number.
        """
        if not isinstance(values, Mapping) or not {"train"} <= set(values) <= {"train", "unseen"}:
            raise ConfigError(
                f"sim_params is {shown(values)}, allowed: {{'train': {{name: [values]}}, 'unseen':"
                " {group: {name: [values]}}}."
            )
        unseen = values.get("unseen", {})
        if isinstance(unseen, Mapping):
            unseen = {name: _to_tuples(group) for name, group in unseen.items()}
        return cls(_to_tuples(values["train"]), unseen)


def _check_values(where: str, values: Any) -> None:
    """Refuse anything but non-empty tuples of finite numbers by name."""
    if not isinstance(values, Mapping) or not values:
        raise ConfigError(
            f"sim_params {where} is {shown(values)}, allowed: one or more values for each"
            " parameter."
        )
    for name, numbers in values.items():
        if not isinstance(numbers, tuple) or not numbers or not all(map(_is_finite, numbers)):
            raise ConfigError(
                f"sim_params {where}, {str(name)[:80]}, is {shown(numbers)}, allowed: one or more"
                " finite numbers."
            )
    if math.prod(map(len, values.values())) > MAX_COMBINATIONS:
        raise ConfigError(
            f"sim_params {where} has too many combinations of values, allowed: at most"
            f" {MAX_COMBINATIONS:,}."
        )


def _is_finite(value: Any) -> bool:
    number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return bool(number and abs(value) <= sys.float_info.max)


def _to_tuples(values: Any) -> Any:
    """Turn JSON's lists into tuples; what is no mapping of lists stays for the checks."""
    if not isinstance(values, Mapping):
        return values
    return {
        name: tuple(numbers) if isinstance(numbers, list | tuple) else numbers
        for name, numbers in values.items()
    }
