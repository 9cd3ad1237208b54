"""GrBAL's network and meta-learning: weights from which one gradient step adapts.

Nagabandi et al., "Learning to adapt in dynamic, real-world environments through
meta-reinforcement learning" (2019); model-agnostic meta-learning, Finn et al. (2017). Fact
sheet E.9.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.config import FittingConfig, ModelConfig
from headway.data import Episodes
from headway.models.compilation import jit_networks
from headway.models.dynamics import Statistics, network_input
from headway.models.fitting import FitData
from headway.models.networks import Dense
from headway.models.updates import EpochStats, Fitted, Tally
from headway.task import Task


class ReluNet(eqx.Module):
    """A plain network that predicts the normalised `delta`."""

    hidden: tuple[Dense, ...]
    output: Dense

    @classmethod
    def init(cls, config: ModelConfig, task: Task, *, key: PRNGKeyArray) -> "ReluNet":
        """Draw Glorot's uniform weights; zero biases."""
        sizes = (task.feature_size + task.action_size, *config.hidden_sizes, task.obs_size)
        keys = jax.random.split(key, len(sizes) - 1)
        *hidden, output = (
            Dense(glorot(key, (1, n, m)), jnp.zeros((1, m)))
            for key, n, m in zip(keys, sizes[:-1], sizes[1:], strict=True)
        )
        return cls(tuple(hidden), output)

    def __call__(self, x: Float[Array, "step in"]) -> Float[Array, "step obs"]:
        """Predict."""
        wide = x[None]
        for layer in self.hidden:
            wide = jax.nn.relu(layer(wide))
        return self.output(wide)[0]


class Window(NamedTuple):
    """Consecutive transitions of one episode, normalised."""

    x: Float[Array, "*batch step in"]
    """Features, then actions."""
    delta: Float[Array, "*batch step obs"]
    weight: Float[Array, "*batch step"]
    """1 for a transition, 0 for padding."""

    @classmethod
    def of(
        cls,
        task: Task,
        statistics: Statistics,
        transitions: tuple[Array, Array, Array],
        weight: Float[Array, "*batch step"],
    ) -> "Window":
        """Normalise observations, actions and next observations."""
        obs, action, next_obs = transitions
        delta = statistics.delta.normalize(task.target(obs, next_obs))
        return cls(network_input(task, statistics, obs, action), delta, weight)


def squared_error(net: ReluNet, window: Window) -> Float[Array, ""]:
    """Mean squared error over the transitions and dimensions of a window."""
    error = jnp.square(net(window.x) - window.delta).mean(-1)
    return (window.weight * error).sum() / jnp.maximum(window.weight.sum(), 1.0)


def adapt(net: ReluNet, past: Window, rate: float) -> ReluNet:
    """Take one step of gradient descent on the past (the inner step).

    Args:
        net: The meta-learned weights.
        past: What just happened.
        rate: Step size.
    """
    grads = jax.grad(squared_error)(net, past)
    return jax.tree.map(lambda weight, grad: weight - rate * grad, net, grads)


def meta_loss(net: ReluNet, past: Window, future: Window, rate: float) -> Float[Array, ""]:
    """Error on the future after adapting to the past, averaged over tasks.

    Its gradient goes through the inner step (second order).

    Args:
        net: The meta-learned weights.
        past: For each task, what precedes a moment; [task, step, ...].
        future: What follows it.
        rate: Step size of the inner step.
    """

    def of_task(past: Window, future: Window) -> Float[Array, ""]:
        return squared_error(adapt(net, past, rate), future)

    return jax.vmap(of_task)(past, future).mean()


class MetaSetup(eqx.Module):
    """What fixes the compiled epoch."""

    task: Task
    fitting: FittingConfig = eqx.field(static=True)
    length: int = eqx.field(static=True)
    """Past transitions that the inner step sees, and future ones that it is judged by."""
    rate: float = eqx.field(static=True)
    """Step size of the inner step."""

    @property
    def num_tasks(self) -> int:
        """Tasks per update: their transitions fill a batch."""
        return max(1, self.fitting.batch_size // (2 * self.length))


def draw_moments(
    data: FitData, setup: MetaSetup, key: PRNGKeyArray
) -> tuple[Int[Array, " task"], Int[Array, " task"]]:
    """Draw an episode and a step of it for each task.

    Long episodes are drawn more often, so that all transitions count the same. A whole past
    fits before the step wherever the episode is long enough.
    """
    row_key, step_key = jax.random.split(key)
    rows = jax.random.randint(row_key, (setup.num_tasks,), 0, data.samples.count)
    episode = data.samples.episode[rows]
    length = data.episodes.length[episode]
    first = jnp.minimum(setup.length, length - 1)
    return episode, jax.random.randint(step_key, episode.shape, first, length)


def window(
    setup: MetaSetup,
    data: FitData,
    episode: Int[Array, " task"],
    start: Int[Array, " task"],
) -> Window:
    """The `length` transitions of each task that begin with a step; those outside weigh 0."""
    episodes: Episodes = data.episodes
    step = start[:, None] + jnp.arange(setup.length)
    inside = (step >= 0) & (step < episodes.length[episode][:, None])
    step = jnp.clip(step, 0, episodes.action.shape[1] - 1)
    rows = episode[:, None]
    transitions = (
        episodes.obs[rows, step],
        episodes.action[rows, step],
        episodes.obs[rows, step + 1],
    )
    return Window.of(setup.task, data.statistics, transitions, inside.astype(jnp.float32))


@jit_networks
def meta_epoch(
    state: Fitted, setup: MetaSetup, data: FitData, *, key: PRNGKeyArray
) -> tuple[Fitted, EpochStats]:
    """Take as many meta-updates as it takes to see as many transitions as there are.

    Args:
        state: Network and optimiser.
        setup: Task and settings.
        data: The data set, with its normalisers.
        key: Draws the tasks.
    """
    per_update = setup.num_tasks * 2 * setup.length
    num_updates = jnp.maximum(data.samples.count // per_update, 1)
    rate = setup.fitting.learning_rate

    def update(i, carry):
        state, tally = carry
        episode, moment = draw_moments(data, setup, jax.random.fold_in(key, i))
        past = window(setup, data, episode, moment - setup.length)
        future = window(setup, data, episode, moment)
        loss, grads = jax.value_and_grad(meta_loss)(state.model, past, future, setup.rate)
        state, skipped = state.step(loss, grads, rate)
        return state, tally.add(loss, skipped)

    state, tally = jax.lax.fori_loop(0, num_updates, update, (state, Tally.zero()))
    return state, tally.stats


def glorot(key: PRNGKeyArray, shape: tuple[int, ...]) -> Array:
    """Uniform draws of variance 2 / (in + out), [..., in, out] (Glorot and Bengio, 2010)."""
    limit = (6.0 / (shape[-2] + shape[-1])) ** 0.5
    return jax.random.uniform(key, shape, minval=-limit, maxval=limit)
