"""Next states of the same states and actions under different physics (supplement, Fig. 8)."""

from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float

from headway import envs
from headway.errors import BadEnvironmentError
from headway.lab.figures import INK, figure, numbers
from headway.lab.tables import Physics, full_label, varying
from headway.task import EnvSpec, env_spec
from headway.training.files import check_target

LONGEST = 1000
"""Steps of a trajectory in an environment that states no length of its episodes."""


def plot_dynamics(env: str, out: str | Path) -> Path:
    """Draw what a trajectory's actions lead to under each training physics.

    A trajectory of random actions is collected under the default physics, or the first of training
    where there are none; in each of its states, the same action is applied under every training
    physics.

    Args:
        env: Short name or id of an environment.
        out: The PNG file to write.

    Returns:
        The file written.

    Raises:
        UnknownNameError: No such environment.
        BadEnvironmentError: The environment's state cannot be copied.
    """
    check_target(Path(out))
    spec = env_spec(env)
    train = spec.sim_params.group("train")
    physics = [train[0] | dict(spec.default_sim_params), *train]
    changes = collect_changes(spec, physics, num_states=100, seed=0)
    default, varied = changes[0], changes[1:]
    first, second = choose_views(varied)
    numbered = (f"observation[{i}]" for i in range(len(spec.obs_names), default.shape[-1]))
    names = [f"change of {name}" for name in (*spec.obs_names, *numbered)]
    caption = (
        f"{spec.name}, {len(default)} states of one trajectory of uniformly random actions under"
        f" the default physics. Every state is drawn once per physics, with the same"
        " action (grey lines join them). The axes are the observation's numbers that differ most"
        " between physics, measured against their own spread. A straight line through 0 on the"
        " right means: proportional to the change under default physics."
    )
    title = "The same states and actions under different physics"
    differ = varying(physics[1:])
    colors = matplotlib.colormaps["plasma"](np.linspace(0.05, 0.85, len(varied)))
    looks = {
        full_label(sim_params, differ): {"color": color, "linestyle": "", "marker": "o"}
        for sim_params, color in zip(physics[1:], colors, strict=True)
    }
    looks["default physics"] = {"color": INK, "linestyle": "", "marker": "."}
    with figure(Path(out), title=title, caption=caption, size=(9.4, 3.6), looks=looks) as drawing:
        plane, against = drawing.subplots(1, 2)
        plane.plot(varied[..., first], varied[..., second], color="#cccccc", linewidth=0.7)
        for change, style in zip([*varied, default], looks.values(), strict=True):
            shared: dict[str, Any] = {**style, "markersize": 4, "markeredgewidth": 0}
            plane.plot(change[:, first], change[:, second], **shared)
            against.plot(default[:, first], change[:, first], **shared)
        numbers(plane, x=names[first], y=names[second])
        numbers(against, x=f"{names[first]}, default physics", y=names[first])
        for axes in (plane, against):
            axes.grid(visible=True, axis="both")
    return Path(out)


def collect_changes(
    spec: EnvSpec, physics: Sequence[Physics], num_states: int, seed: int
) -> Float[np.ndarray, "physics state obs"]:
    """Collect a trajectory under the first physics, and changes of observations under all.

    Args:
        spec: The environment.
        physics: What each of the trajectory's actions is applied under.
        num_states: States to compare, evenly spread over one trajectory.
        seed: Seeds the trajectory and its actions.

    Raises:
        BadEnvironmentError: The environment's state cannot be copied.
    """
    with closing(envs.make(spec.name)) as environment:
        world: Any = environment.unwrapped
        for method in ("get_state", "set_state", "set_sim_params", "observation"):
            if not hasattr(world, method):
                raise BadEnvironmentError(
                    f"{spec.name} has no method {method}, allowed: environments with get_state,"
                    " set_state, set_sim_params and observation; add them to draw its dynamics."
                )
        world.action_space.seed(seed)
        world.reset(seed=seed, options={"sim_params": dict(physics[0])})
        trajectory = []
        for _ in range(spec.episode_length or LONGEST):
            trajectory.append((world.get_state(), world.action_space.sample()))
            if any(world.step(trajectory[-1][1])[2:4]):
                break
        steps = np.linspace(0, len(trajectory) - 1, min(num_states, len(trajectory)), dtype=int)
        changes = []
        for sim_params in physics:
            world.set_sim_params(sim_params)
            for step in steps:
                state, action = trajectory[step]
                world.set_state(state)
                before = np.asarray(world.observation(), np.float64)
                changes.append(np.asarray(world.step(action)[0], np.float64) - before)
    return np.stack(changes).reshape(len(physics), len(steps), -1)


def choose_views(changes: Float[np.ndarray, "physics state obs"]) -> tuple[int, int]:
    """Choose the two numbers of the observation that tell the physics apart best.

    For each number, the spread between physics (of the same state and action) is measured
    against its whole spread over states and physics. The second is the best one that is not
    nearly a copy of the first.
    """
    whole, between = changes.std((0, 1)), changes.std(0).mean(0)
    share = np.where(whole > 1e-9, between / np.maximum(whole, 1e-9), 0.0)
    first, *others = (int(i) for i in np.argsort(-share, kind="stable"))
    flat = changes.reshape(-1, changes.shape[-1])
    others = [i for i in others if whole[i] > 1e-9]
    apart = [i for i in others if abs(np.corrcoef(flat[:, first], flat[:, i])[0, 1]) < 0.95]
    return first, (apart or others or [first])[0]
