"""What a run's context encoder makes of the physics it was trained on."""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from headway.data import Trajectory
from headway.errors import RunError
from headway.planning.agent import Agent, encode
from headway.planning.heads import RecentTransitions
from headway.report.page.runs import LoadedRun
from headway.training.loading import load_agent
from headway.training.run import RunDir

NUM_MOMENTS = 320  # of the collected episodes, evenly spread


@dataclasses.dataclass(frozen=True)
class Embedding:
    """Context vectors of moments of collected episodes, from one run's encoder."""

    points: Float[np.ndarray, "point 2"]
    """The first member's contexts on their first two principal components."""
    explained: Float[np.ndarray, " 2"]
    """Share of the variance that each of the two has."""
    physics: list[dict[str, float]]
    """The simulator parameters under which each moment happened."""
    told_apart: Float[np.ndarray, " member"]
    """Share of the contexts' variance that lies between physics, for every member."""


def embed(run: LoadedRun) -> Embedding | None:
    """Encode what a run collected; None for a model without a learned context.

    Raises:
        RunError: The run has no checkpoint or no collected data, or they are damaged; or none of
            its episodes is longer than the history.
    """
    if run.config.model.kind != "multi-headed":
        return None
    directory = RunDir(run.path)
    agent = load_agent(directory, run.config)
    assert isinstance(agent, Agent)
    if agent.model.context_encoder is None:
        return None
    chosen = moments(directory.load_data(), agent.history_length)
    if not chosen:
        raise RunError(
            f"none of its collected episodes is longer than {agent.history_length} steps, which are"
            " the history that a context is made of."
        )
    contexts = encode_moments(agent, chosen)
    physics = [dict(trajectory.sim_params) for trajectory, _ in chosen]
    points, explained = principal_components(contexts[0])
    shares = np.array([variance_between(member, physics) for member in contexts])
    return Embedding(points, explained, physics, shares)


def moments(trajectories: list[Trajectory], history_length: int) -> list[tuple[Trajectory, int]]:
    """Evenly spread moments that have a whole history behind them."""
    found = [(t, step) for t in trajectories for step in range(history_length, len(t))]
    wanted = np.linspace(0, len(found) - 1, min(NUM_MOMENTS, len(found)), dtype=int)
    return [found[i] for i in wanted]


def encode_moments(
    agent: Agent, chosen: list[tuple[Trajectory, int]]
) -> Float[np.ndarray, "member point context"]:
    """The context vectors of every member."""
    length = agent.history_length

    def cut(name: str, shift: int):
        rows = [getattr(t, name)[s - length + shift : s + shift] for t, s in chosen]
        return jnp.asarray(np.stack(rows))

    count = jnp.full(len(chosen), length, jnp.int32)
    recent = RecentTransitions(cut("obs", 0), cut("action", 0), cut("obs", 1), count)
    return np.asarray(encode(agent, recent), np.float64)


def principal_components(
    vectors: Float[np.ndarray, "point size"],
) -> tuple[Float[np.ndarray, "point 2"], Float[np.ndarray, " 2"]]:
    """Project vectors on their two directions of greatest variance.

    Each direction points to where its largest entry is positive, so that figures are repeatable.

    Returns:
        The projections, and the share of the variance that each has.
    """
    centred = vectors - vectors.mean(0)
    _, scales, directions = np.linalg.svd(centred, full_matrices=False)
    scales, directions = scales[:2], directions[:2]
    largest = np.abs(directions).argmax(1)[:, None]
    directions = directions * np.sign(np.take_along_axis(directions, largest, axis=1))
    points, total = centred @ directions.T, max(float(np.square(centred).sum()), 1e-30)
    missing = 2 - points.shape[1]
    explained = np.pad(np.square(scales) / total, (0, missing))
    return np.pad(points, ((0, 0), (0, missing))), explained


def variance_between(
    vectors: Float[np.ndarray, "point size"], physics: list[dict[str, float]]
) -> float:
    """Share of the variance that lies between physics: 1 tells them apart, 0 says nothing."""
    keys = [tuple(sorted(p.items())) for p in physics]
    centred = vectors - vectors.mean(0)
    means = {key: centred[[k == key for k in keys]].mean(0) for key in set(keys)}
    between = sum(float(np.square(means[key]).sum()) for key in keys)
    return between / max(float(np.square(centred).sum()), 1e-30)
