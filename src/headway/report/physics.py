"""How simulator parameters are written for readers."""

from collections.abc import Iterable, Mapping, Sequence

UNITS = {"length": "m", "mass": "kg"}

SimParams = Mapping[str, float]


def distinct(physics: Iterable[SimParams]) -> list[dict[str, float]]:
    """Every different set of simulator parameters, in ascending order."""
    unique = {tuple(sorted(sim_params.items())): dict(sim_params) for sim_params in physics}
    return sorted(unique.values(), key=lambda sim_params: sorted(sim_params.items()))


def varying(physics: Sequence[SimParams]) -> list[str]:
    """Names of the parameters that differ; all of them when none does."""
    names = sorted({name for sim_params in physics for name in sim_params})
    differ = [name for name in names if len({p.get(name) for p in physics}) > 1]
    return differ or names


def value_label(sim_params: SimParams, names: Sequence[str]) -> str:
    """Write the values of some parameters, for example `0.5` or `0.5, 2`."""
    return ", ".join(f"{sim_params[name]:g}" for name in names if name in sim_params)


def axis_label(names: Sequence[str]) -> str:
    """Write the names of some parameters with their units, for example `length (m)`."""
    return ", ".join(
        name.replace("_", " ") + (f" ({UNITS[name]})" if name in UNITS else "") for name in names
    )


def full_label(sim_params: SimParams, names: Sequence[str]) -> str:
    """Write names, values and units, for example `length 0.5 m`."""
    return ", ".join(
        f"{name.replace('_', ' ')} {sim_params[name]:g}"
        + (f" {UNITS[name]}" if name in UNITS else "")
        for name in names
        if name in sim_params
    )
