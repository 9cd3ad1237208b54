"""What the same action does to the same state under different physics (supplement, Fig. 8)."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes

from headway import envs
from headway.errors import BadEnvironmentError, ConfigError
from headway.report.obs_names import obs_names
from headway.report.physics import SimParams, full_label, varying
from headway.report.style import INK, THREAD, figure, label_axis, legend
from headway.task import EnvSpec, env_spec


@dataclasses.dataclass(frozen=True)
class Changes:
    """Next observation minus observation, for each physics and state of one trajectory."""

    physics: list[dict[str, float]]
    """The training physics, in the order of their sets."""
    varied: Float[np.ndarray, "physics state obs"]
    """What the trajectory's actions change under each of them."""
    default: Float[np.ndarray, "state obs"]
    """What they change under the default physics."""


@dataclasses.dataclass(frozen=True)
class View:
    """One number made of an observation's change, and how to call it."""

    weights: Float[np.ndarray, " obs"]
    label: str

    def __call__(self, changes: Float[np.ndarray, "*batch obs"]) -> Float[np.ndarray, "*batch"]:
        """Project changes."""
        return changes @ self.weights


def plot_dynamics(env: str, out: str | Path, *, num_states: int = 100, seed: int = 0) -> Path:
    """Draw what a trajectory's actions lead to under each training physics.

    A trajectory of random actions is collected in the default environment; in each of its
    states, the same action is applied under every training physics.

    Args:
        env: Short name or id of an environment.
        out: The PNG file to write.
        num_states: States drawn, evenly spread over the trajectory.
        seed: Seeds the trajectory and its actions.

    Returns:
        The file written.

    Raises:
        UnknownNameError: No such environment.
        ConfigError: `num_states` is less than 1.
    """
    if num_states < 1:
        raise ConfigError(f"num_states is {num_states}, allowed: at least 1.")
    spec = env_spec(env)
    changes = collect_changes(spec, num_states, seed)
    first, second = choose_views(changes, obs_names(spec.name, changes.default.shape[-1]))
    caption = (
        f"{spec.name}, {len(changes.default)} states of one trajectory of uniformly random actions"
        f" under the default physics, seed {seed}. Every state is drawn once per physics, with"
        " the same action (grey lines join them). The axes are the observation's numbers that"
        " differ most between physics, measured against their own spread. A straight line through"
        " 0 on the right"
        " means: proportional to the change under default physics."
    )
    title = "The same states and actions under different physics"
    with figure(Path(out), title=title, caption=caption, size=(9.6, 4.9)) as drawing:
        plane, against = drawing.subplots(1, 2)
        _draw(plane, changes, first, second)
        label_axis(plane, first.label, second.label)
        _draw(against, changes, first, None)
        label_axis(against, f"{first.label}, default physics", first.label)
        legend(drawing)
    return Path(out)


def collect_changes(spec: EnvSpec, num_states: int, seed: int) -> Changes:
    """Collect a trajectory under default physics, and what its actions do under all others.

    Args:
        spec: The environment.
        num_states: States to compare, evenly spread over one trajectory.
        seed: Seeds the trajectory and its actions.

    Raises:
        BadEnvironmentError: The environment's state cannot be copied.
    """
    environment = envs.make(spec.name)
    world: Any = environment.unwrapped
    for method in ("get_state", "set_state", "set_sim_params", "observation"):
        if not hasattr(world, method):
            raise BadEnvironmentError(
                f"{spec.name} has no method {method}, allowed: environments with get_state,"
                " set_state, set_sim_params and observation; add them to draw its dynamics."
            )
    default = dict(spec.default_sim_params)
    physics = spec.sim_params.group("train")
    world.action_space.seed(seed)
    world.reset(seed=seed, options={"sim_params": default})
    trajectory = []
    for _ in range(spec.episode_length):
        trajectory.append((world.get_state(), world.action_space.sample()))
        if world.step(trajectory[-1][1])[2]:
            break
    steps = np.linspace(0, len(trajectory) - 1, min(num_states, len(trajectory)), dtype=int)
    kept = [trajectory[step] for step in steps]
    changes = [_changes_under(world, sim_params, kept) for sim_params in (default, *physics)]
    environment.close()
    return Changes(physics, np.stack(changes[1:]), changes[0])


def _changes_under(
    world: Any, sim_params: SimParams, kept: Sequence[tuple[Any, np.ndarray]]
) -> Float[np.ndarray, "state obs"]:
    """Change of the observation after one step from each state, with its action."""
    world.set_sim_params(sim_params)
    changes = []
    for state, action in kept:
        world.set_state(state)
        obs = np.asarray(world.observation(), np.float64)
        changes.append(np.asarray(world.step(action)[0], np.float64) - obs)
    return np.stack(changes)


def choose_views(changes: Changes, names: Sequence[str]) -> tuple[View, View]:
    """Choose the two numbers of the observation that tell the physics apart best.

    For each number, the spread between physics (of the same state and action) is measured
    against its whole spread over states and physics. The second is the best one that is not
    nearly a copy of the first.

    Args:
        changes: What was collected.
        names: A name for each number of the observation.
    """
    varied = changes.varied
    whole = varied.std((0, 1))
    between = varied.std(0).mean(0)
    share = np.where(whole > 1e-9, between / np.maximum(whole, 1e-9), 0.0)
    order = np.argsort(-share, kind="stable")
    first = int(order[0])
    flat = varied.reshape(-1, varied.shape[-1])
    others = [int(i) for i in order[1:] if whole[i] > 1e-9]
    apart = [i for i in others if abs(np.corrcoef(flat[:, first], flat[:, i])[0, 1]) < 0.95]
    second = (apart or others or [first])[0]
    return _view(first, names), _view(second, names)


def _view(index: int, names: Sequence[str]) -> View:
    return View(np.eye(len(names))[index], f"change of {names[index]} in one step")


def _draw(axes: Axes, changes: Changes, x: View, y: View | None) -> None:
    """Draw a cloud per physics, the default one in black; without `y`, `x` over its default."""
    colors = matplotlib.colormaps["plasma"](np.linspace(0.05, 0.85, len(changes.physics)))
    names = varying(changes.physics)
    if y is not None:
        axes.plot(x(changes.varied), y(changes.varied), color=THREAD, linewidth=0.7, zorder=1)
    for change, sim_params, color in zip(changes.varied, changes.physics, colors, strict=True):
        across = x(change) if y is not None else x(changes.default)
        up = y(change) if y is not None else x(change)
        label = full_label(sim_params, names)
        axes.scatter(across, up, s=15, color=color, linewidths=0, label=label)
    across = x(changes.default)
    up = y(changes.default) if y is not None else across
    style = {"color": INK, "s": 7, "linewidths": 0, "zorder": 3}
    axes.scatter(across, up, label="default physics", **style)
    axes.grid(visible=y is None, axis="both")
