"""GrBAL: meta-learned weights, from which one gradient step adapts to the present episode.

Nagabandi et al., "Learning to adapt in dynamic, real-world environments through
meta-reinforcement learning" (2019); model-agnostic meta-learning, Finn et al. (2017). Fact
sheet E.9.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int, PRNGKeyArray

from headway.config import ModelConfig, Precision
from headway.data import where_env
from headway.models.base import (
    Dynamics,
    Keys,
    Layer,
    Model,
    RecentTransitions,
    Transition,
    over_rows,
    plan_layers,
)
from headway.models.compilation import jit_networks
from headway.models.fitting import EpochStats, FitData, FitSetup, FitState, run_updates
from headway.models.networks import Dense
from headway.models.statistics import Statistics, network_input
from headway.task import Task

glorot = jax.nn.initializers.glorot_uniform(batch_axis=0)
"""Uniform draws of variance 2 / (in + out), [member, in, out] (Glorot and Bengio, 2010)."""


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


@jit_networks
def meta_epoch(
    state: FitState,
    setup: FitSetup,
    data: FitData,
    *,
    length: int,
    rate: float,
    key: PRNGKeyArray,
) -> tuple[FitState, EpochStats]:
    """Take as many meta-updates as it takes to see as many transitions as there are.

    A task is an episode and a step of it; the transitions of an update's tasks fill a batch. Long
    episodes are drawn more often, so that all transitions count the same. A whole past fits before
    the step wherever the episode is long enough.

    Args:
        state: Network and optimiser.
        setup: Task and settings.
        data: The data set, with its normalisers.
        length: Past transitions that the inner step sees, and future ones that judge it.
        rate: Step size of the inner step.
        key: Draws the tasks.
    """
    config, samples, lengths = setup.config, data.samples, data.episodes.length
    num_tasks = tasks_per_update(config.batch_size, length)
    num_updates = jnp.maximum(samples.count // (2 * length * num_tasks), 1)

    def update(i, state):
        row_key, step_key = jax.random.split(jax.random.fold_in(key, i))
        rows = jax.random.randint(row_key, (num_tasks,), 0, samples.count)
        episode = samples.episode[rows]
        first = jnp.minimum(length, lengths[episode] - 1)
        step = jax.random.randint(step_key, (num_tasks,), first, lengths[episode])
        past = window(setup.task, data, episode, step - length, length)
        future = window(setup.task, data, episode, step, length)
        loss, grads = jax.value_and_grad(meta_loss)(state.model, past, future, rate)
        state, skipped = state.step(loss, grads, config.learning_rate)
        return state, loss, loss, skipped

    return run_updates(state, num_updates, update)


def tasks_per_update(batch_size: int, length: int) -> int:
    """Tasks whose pasts and futures, each of so many transitions, fill a batch."""
    return max(1, batch_size // (2 * length))


def window(
    task: Task,
    data: FitData,
    episode: Int[Array, " task"],
    start: Int[Array, " task"],
    length: int,
) -> Window:
    """The `length` transitions of each task that begin with a step; those outside weigh 0."""
    episodes = data.episodes
    step = start[:, None] + jnp.arange(length)
    inside = (step >= 0) & (step < episodes.length[episode][:, None])
    step = jnp.clip(step, 0, episodes.action.shape[1] - 1)
    rows = episode[:, None]
    obs, action = episodes.obs[rows, step], episodes.action[rows, step]
    transitions = obs, action, episodes.obs[rows, step + 1]
    return Window.of(task, data.statistics, transitions, inside.astype(jnp.float32))


class GrBAL(Model):
    """One gradient step on the newest transitions, from the meta-learned weights.

    Until an episode has `length` transitions, the meta-learned weights themselves predict.
    """

    net: ReluNet
    statistics: Statistics
    task: Task
    length: int = eqx.field(static=True)
    rate: float = eqx.field(static=True)

    @property
    def memory(self) -> int:
        """See `Model.memory`."""
        return self.length

    def init_belief(self, num_envs: int, sim_params: None = None) -> RecentTransitions:
        """See `Model.init_belief`: the transitions to adapt to."""
        return RecentTransitions.empty(num_envs, self.length, self.task)

    def observe(
        self, belief: RecentTransitions, transition: Transition, keys: Keys
    ) -> RecentTransitions:
        """See `Model.observe`."""
        return belief.push(transition)

    def dynamics(
        self, belief: RecentTransitions, precision: Precision = "float32"
    ) -> "AdaptedDynamics":
        """See `Model.dynamics`: the weights of every environment, adapted."""
        past = Window.of(self.task, self.statistics, belief[:3], jnp.ones(belief.obs.shape[:2]))
        adapted = jax.vmap(lambda past: adapt(self.net, past, self.rate))(past)
        net = where_env(belief.count >= self.length, adapted, self.net)
        layers = plan_layers((*net.hidden, net.output), precision)
        return AdaptedDynamics(layers, self.statistics, self.task)


class PlainDynamics(Dynamics):
    """A network without heads: how observations enter and leave it, in the layout of a plan."""

    statistics: Statistics
    task: Task

    def wide_input(
        self,
        obs: Float[Array, "1 obs particle candidate"],
        action: Float[Array, "1 action particle candidate"],
    ) -> Float[Array, "1 in particle candidate"]:
        """`network_input` of every row."""
        return over_rows(functools.partial(network_input, self.task, self.statistics))(obs, action)

    def next_obs(
        self,
        obs: Float[Array, "1 obs particle candidate"],
        normalized: Float[Array, "1 obs particle candidate"],
    ) -> Float[Array, "1 obs particle candidate"]:
        """Next observation after a predicted, normalised `delta`."""
        delta = over_rows(self.statistics.delta.denormalize)(normalized)
        return over_rows(self.task.postprocess)(obs, delta)


class AdaptedDynamics(PlainDynamics):
    """A plain network whose weights differ between environments."""

    own: tuple[Layer, ...]

    def step(self, carry, obs, action, noise):
        """See `Dynamics.step`."""
        x = self.wide_input(obs, action)
        *hidden, output = self.own
        for layer in hidden:
            x = jax.nn.relu(layer(x))
        return carry, self.next_obs(obs, output(x))
