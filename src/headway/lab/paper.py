"""The paper's experiments as one table: named comparisons, each a list of arms.

An arm is a method with some settings, trained and tested with them: where an arm changes the
planner, it also collects its data with that planner, as the released code does. Values that the
supplement does not give (Figs. 14 to 16) are the project's. Arms with the same settings in two
experiments share their runs.
"""

import dataclasses
import itertools
import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal

from headway.errors import ConfigError, UnknownNameError, check_names, shown
from headway.training.methods import METHODS, NO_CONTEXT, REFERENCES, Settings

PAPER_ENVS = (
    "cartpole-swingup", "pendulum", "hopper", "slim-humanoid", "half-cheetah", "crippled-ant",
)  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Arm:
    """One of the things that an experiment compares."""

    label: str
    """As it stands in figures and tables; where arms are methods, their names."""
    method: str = "tmcl"
    """A name of the table of methods."""
    settings: Settings = dataclasses.field(default_factory=dict)
    """Changes of the method, by dotted name."""


@dataclasses.dataclass(frozen=True)
class Experiment:
    """A comparison: arms that are run in the same environments with the same seeds."""

    name: str
    """As the command line takes it."""
    title: str
    """A few words for headings."""
    arms: tuple[Arm, ...]
    """In the order of the figure."""
    reference: str = ""
    """Label of the arm that the others are compared with; the first one by default."""
    measure: Literal["unseen", "collected"] = "unseen"
    """Returns on unseen physics, or those of the episodes collected for training."""


_METHODS = tuple(Arm(name, name) for name in METHODS)
_LEARNING = tuple(arm for arm in _METHODS if arm.method not in REFERENCES)
_AVERAGE = {"planner.head_selection": "average"}
# The preset `released-code` would skip the only transition.
_ONLY_NEWEST = {"planner.selection_length": 1, "planner.selection_skips_newest": False}


def _values(letter: str, setting: str, *values: int) -> tuple[Arm, ...]:
    return tuple(Arm(f"{letter} = {value}", settings={setting: value}) for value in values)


_EXPERIMENTS = (
    Experiment("comparison", "every method on unseen physics", _METHODS),
    Experiment("fig9", "every method while learning", _LEARNING, measure="collected"),
    Experiment(
        "fig10",
        "PETS with one head and with several",
        (Arm("pets", "pets"), Arm("mh-pets", "mh-pets")),
        "mh-pets",
    ),
    Experiment(
        "fig11",
        "adaptive and non-adaptive planning",
        (Arm("adaptive"), Arm("non-adaptive (average)", settings=_AVERAGE)),
    ),
    Experiment(
        "fig12",
        "with and without context learning",
        (Arm("with context"), Arm("without context", settings=NO_CONTEXT)),
    ),
    Experiment("fig13", "MCL and T-MCL", (Arm("mcl", "mcl"), Arm("tmcl")), "tmcl"),
    Experiment(
        "fig14",
        "number of prediction heads H",
        _values("H", "model.num_heads", 1, 2, 3, 5, 8),
        "H = 3",
    ),
    Experiment(
        "fig15",
        "segment length M of the oracle loss",
        # Heads that compete for segments of one transition are MCL, so these share their runs.
        (Arm("M = 1", "mcl"), *_values("M", "fitting.segment_length", 5, 10, 20, 50)),
        "M = 10",
    ),
    Experiment(
        "fig16",
        "past transitions N that select a head",
        (
            Arm("N = 1", settings=_ONLY_NEWEST),
            *_values("N", "planner.selection_length", 5, 10, 20, 50),
        ),
        "N = 10",
    ),
)

EXPERIMENTS: dict[str, Experiment] = {experiment.name: experiment for experiment in _EXPERIMENTS}


def experiment(name: str) -> Experiment:
    """Look an experiment up.

    Raises:
        UnknownNameError: No such experiment.
    """
    if name == "fig8":
        raise UnknownNameError(
            "fig8 compares no methods: it shows what an action leads to under different physics;"
            " `headway plot-dynamics ENV` draws it."
        )
    check_names("experiment", [name], EXPERIMENTS)
    return EXPERIMENTS[name]


def sweep_experiment(
    name: str, methods: Sequence[str], grid: Mapping[str, Sequence[Any]]
) -> Experiment:
    """An experiment of one's own: every method with every combination of some settings.

    Args:
        name: Names the folder of its results.
        methods: Names of the table of methods.
        grid: Values of settings by dotted name.

    Raises:
        ConfigError: The name is no plain name, or something is asked for twice.
    """
    if not re.fullmatch(r"[\w-]{1,60}", name) or name in EXPERIMENTS:
        raise ConfigError(
            f"the sweep's name is {shown(name)}, allowed: letters, digits, - and _, and none of"
            f" {', '.join(EXPERIMENTS)}."
        )
    arms = []
    for method, *values in itertools.product(methods, *grid.values()):
        chosen = dict(zip(grid, values, strict=True))
        parts = [method, *(f"{n} {v}" for n, v in chosen.items())]
        arms.append(Arm(", ".join(parts), method, chosen))
    labels = [arm.label for arm in arms]
    if not labels or len(set(labels)) < len(labels):
        raise ConfigError("a sweep names a method or a value twice, or none; allowed: each once.")
    title = " and ".join(["methods", *grid])
    return Experiment(name, title, tuple(arms))
