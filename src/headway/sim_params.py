"""Simulator parameters: the hidden physics of an environment, and the sets they come from."""

import dataclasses
import itertools
import math
import sys
from collections.abc import Mapping
from typing import Any

import numpy as np

from headway.errors import ConfigError, check_names, shown

MAX_COMBINATIONS = 100_000
"""Physics that one group may stand for."""
QUANTILES = 5
"""Values that stand for a range where physics are counted or listed."""


@dataclasses.dataclass(frozen=True)
class Uniform:
    """A range of a parameter's values, from which training draws evenly; in JSON a table.

    Tests go through evenly spaced values of it, both ends among them; five stand for it in lists.

    Example:
        >>> SimParamSets({"mass": Uniform(0.5, 2.5)}).group("train")
        [{'mass': 0.5}, {'mass': 1.0}, {'mass': 1.5}, {'mass': 2.0}, {'mass': 2.5}]

    Raises:
        ConfigError: An end is no finite number, or they are not in order.
    """

    low: float
    """Its least value."""
    high: float
    """Its largest value."""

    def __post_init__(self) -> None:
        if not (is_finite(self.low) and is_finite(self.high) and self.low < self.high):
            raise ConfigError(
                f"Uniform is from {shown(self.low)} to {shown(self.high)}, allowed: finite"
                " numbers, the lower one first."
            )
        for name in ("low", "high"):
            object.__setattr__(self, name, float(getattr(self, name)))


Values = Mapping[str, tuple[float, ...] | Uniform]


@dataclasses.dataclass(frozen=True)
class SimParamSets:
    """The physics to train on, and groups of physics kept for testing.

    Values of different parameters are independent: a set stands for all their combinations.

    Example:
        >>> sets = SimParamSets({"length": [0.5, 1.0]}, {"long": {"length": np.linspace(2, 3, 2)}})
        >>> sets.group_names
        ('train', 'long')
        >>> sets.group("long")
        [{'length': 2.0}, {'length': 3.0}]

    Raises:
        ConfigError: A part is missing, unknown, of the wrong type, or no finite number.
    """

    train: Values
    """Values of each parameter during training: a tuple, list, range or array, or a `Uniform`."""
    unseen: Mapping[str, Values] = dataclasses.field(default_factory=dict)
    """Values of each parameter in each group of test physics, by the group's name."""

    def __post_init__(self) -> None:
        if not isinstance(self.unseen, Mapping) or "train" in self.unseen:
            raise ConfigError(
                f"sim_params unseen is {shown(self.unseen)}, allowed: parameter values by the"
                " names of groups other than 'train'."
            )
        object.__setattr__(self, "train", _checked("train", self.train))
        unseen = {}
        for name, values in self.unseen.items():
            unseen[str(name)] = _checked(f"unseen group {shown(name)}", values)
            if set(values) != set(self.train):
                raise ConfigError(
                    f"sim_params unseen group {name!r} has {', '.join(map(str, values))}, allowed:"
                    f" a value for every parameter of train, {', '.join(self.train)}."
                )
        object.__setattr__(self, "unseen", unseen)

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
            name: float(rng.uniform(values.low, values.high))
            if isinstance(values, Uniform)
            else values[rng.integers(len(values))]
            for name, values in self.train.items()
        }

    def deal(self, rng: np.random.Generator, count: int) -> list[dict[str, float]]:
        """Draw so many training physics, with every value of a parameter about equally often."""
        columns = {}
        for name, values in self.train.items():
            places = rng.permutation(count)
            if isinstance(values, Uniform):
                shares = (places + rng.random(count)) / count
                columns[name] = values.low + shares * (values.high - values.low)
            else:
                columns[name] = rng.permutation(values)[places % len(values)]
        return [{name: float(column[i]) for name, column in columns.items()} for i in range(count)]

    def nearest(self, sim_params: Mapping[str, float]) -> dict[str, float]:
        """Return the training physics of `group` that drawn ones are counted with.

        What else is there, such as the number of a recording, stays.
        """
        return {
            name: min(_column(self.train.get(name, (value,))), key=lambda one: abs(one - value))
            for name, value in sim_params.items()
        }

    def group(self, name: str) -> list[dict[str, float]]:
        """Return every combination of a group's values; quantiles stand for a range.

        Raises:
            UnknownNameError: There is no such group.
        """
        values = self._values(name)
        columns = map(_column, values.values())
        return [dict(zip(values, row, strict=True)) for row in itertools.product(*columns)]

    def spread(self, name: str, count: int) -> list[dict[str, float]]:
        """Return so many physics of a group, with every value of a parameter equally often.

        All combinations in turn if there are not more than `count`. Else, and where there is a
        range, a Latin hypercube: each parameter goes evenly through its values, in an order of
        its own that is always the same.

        Raises:
            UnknownNameError: There is no such group.
        """
        combinations, values = self.group(name), self._values(name)
        ranges = any(isinstance(column, Uniform) for column in values.values())
        if count >= len(combinations) and not ranges:
            return [combinations[i % len(combinations)] for i in range(count)]
        rng, columns = np.random.default_rng(0), {}
        for key, column in values.items():
            given = np.array(_column(column, count))
            columns[key] = given[rng.permutation(np.arange(count) * len(given) // count)]
        return [{key: float(column[i]) for key, column in columns.items()} for i in range(count)]

    def _values(self, name: str) -> Values:
        check_names("group", [name], self.group_names)
        return self.train if name == "train" else self.unseen[name]

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> "SimParamSets":
        """Rebuild what `dataclasses.asdict` took apart.

        Raises:
            ConfigError: A part is missing, unknown, of the wrong type, or no finite number.
        """
        if not isinstance(values, Mapping) or not {"train"} <= set(values) <= {"train", "unseen"}:
            raise ConfigError(
                f"sim_params is {shown(values)}, allowed: {{'train': {{name: [values]}}, 'unseen':"
                " {group: {name: [values]}}}."
            )
        return cls(**values)


def _column(values: tuple[float, ...] | Uniform, count: int = QUANTILES) -> tuple[float, ...]:
    """Return all values of a parameter; of a range so many, both ends or else its middle."""
    if not isinstance(values, Uniform):
        return values
    low = values.low if count > 1 else (values.low + values.high) / 2
    return tuple(np.linspace(low, values.high, count).tolist())


def _checked(where: str, values: Any) -> Values:
    """Return a group's values as tuples; refuse anything but some finite numbers by name."""
    if not isinstance(values, Mapping) or not values:
        raise ConfigError(
            f"sim_params {where} is {shown(values)}, allowed: one or more values for each"
            " parameter."
        )
    checked = {}
    for name, given in values.items():
        column = given.tolist() if hasattr(given, "tolist") else given  # also pandas, JAX
        if isinstance(column, Mapping) and set(column) == {"low", "high"}:
            column = Uniform(**column)
        if isinstance(column, Uniform):
            checked[name] = column
            continue
        listed = isinstance(column, list | tuple | range) and column and isinstance(name, str)
        if not listed or not all(map(is_finite, column)):
            raise ConfigError(
                f"sim_params {where}, {str(name)[:80]}, is {shown(column)}, allowed: for a name one"
                " or more finite numbers, or a range {'low': number, 'high': number}."
            )
        checked[name] = tuple(map(float, column))
    if math.prod(len(_column(column)) for column in checked.values()) > MAX_COMBINATIONS:
        raise ConfigError(
            f"sim_params {where} has too many combinations of values, allowed: at most"
            f" {MAX_COMBINATIONS:,}."
        )
    return checked


def is_finite(value: Any) -> bool:
    """Tell whether a value is one finite number, of Python or NumPy; a truth value is none."""
    if isinstance(value, np.generic):
        value = value.item()
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return number and abs(value) <= sys.float_info.max
