"""ReBAL: a recurrent network, fitted by truncated backpropagation through time.

Nagabandi et al., "Learning to adapt in dynamic, real-world environments through
meta-reinforcement learning" (2019).
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from headway.config import ModelConfig, Precision
from headway.data import where_env
from headway.models.base import Keys, Layer, Model, Transition, plan_layers
from headway.models.compilation import jit_networks
from headway.models.fitting import EpochStats, FitData, FitSetup, FitState, run_updates
from headway.models.grbal import PlainDynamics, Window, glorot, window
from headway.models.networks import Dense
from headway.models.statistics import Statistics, network_input
from headway.task import Task

FORGET_BIAS = 1.0


class CellState(NamedTuple):
    """Recurrent state of one layer."""

    hidden: Float[Array, "*batch size"]
    cell: Float[Array, "*batch size"]


class RecurrentNet(eqx.Module):
    """Layers of long short-term memory, and a linear output: the normalised `delta`.

    A layer's weights take its input, then its own hidden state, to the gates in the order
    input, forget, candidate, output (Hochreiter and Schmidhuber, 1997; Gers et al., 2000).
    """

    layers: tuple[Dense, ...]
    output: Dense

    @classmethod
    def init(cls, config: ModelConfig, task: Task, *, key: PRNGKeyArray) -> "RecurrentNet":
        """Draw Glorot's uniform weights; zero biases, but 1 for the forget gates."""
        sizes = (task.feature_size + task.action_size, *config.hidden_sizes)
        *keys, last = jax.random.split(key, len(sizes))
        layers = []
        for one, n, m in zip(keys, sizes[:-1], sizes[1:], strict=True):
            bias = jnp.zeros((1, 4 * m)).at[:, m : 2 * m].set(FORGET_BIAS)
            layers.append(Dense(glorot(one, (1, n + m, 4 * m)), bias))
        weight = glorot(last, (1, sizes[-1], task.obs_size))
        return cls(tuple(layers), Dense(weight, jnp.zeros((1, task.obs_size))))

    @property
    def sizes(self) -> tuple[int, ...]:
        """Units of each layer."""
        return tuple(layer.bias.shape[-1] // 4 for layer in self.layers)

    def start(self, *batch: int) -> tuple[CellState, ...]:
        """Remember nothing: zeros."""
        return tuple(CellState(jnp.zeros((*batch, m)), jnp.zeros((*batch, m))) for m in self.sizes)

    def __call__(
        self, state: tuple[CellState, ...], x: Float[Array, "batch in"]
    ) -> tuple[tuple[CellState, ...], Float[Array, "batch obs"]]:
        """Take one step in time; return the new state and the prediction."""
        states = []
        for layer, before in zip(self.layers, state, strict=True):
            gates = layer(jnp.concatenate([x, before.hidden], axis=-1)[None])[0]
            after = next_cell(before, gates, axis=-1)
            states.append(after)
            x = after.hidden
        return tuple(states), self.output(x[None])[0]


def next_cell(before: CellState, gates: Float[Array, "*gates"], axis: int) -> CellState:
    """One step of long short-term memory, from the gates before their nonlinearities.

    Args:
        before: The last state.
        gates: Input, forget, candidate and output, one after the other.
        axis: The axis of units.
    """
    let_in, keep, candidate, let_out = jnp.split(gates, 4, axis=axis)
    cell = jax.nn.sigmoid(keep) * before.cell + jax.nn.sigmoid(let_in) * jnp.tanh(candidate)
    return CellState(jax.nn.sigmoid(let_out) * jnp.tanh(cell), cell)


def batch_gradient(
    net: RecurrentNet, batch: Window, steps: int
) -> tuple[Float[Array, ""], RecurrentNet]:
    """Mean squared error over whole episodes, and its gradient, truncated in time.

    The episodes are gone through in chunks. A chunk begins with the state that the last one
    ended with, and no gradient flows back into that.

    Args:
        net: The network.
        batch: Whole episodes from their first step, [episode, step, ...]; padded at the end.
        steps: Steps of a chunk.
    """
    total = jnp.maximum(batch.weight.sum(), 1.0)
    length = batch.weight.shape[1]
    padding = -length % steps

    def chunked(values: Array) -> Array:
        """As [chunk, step, episode, ...]."""
        padded = jnp.pad(values, [(0, 0), (0, padding)] + [(0, 0)] * (values.ndim - 2))
        chunks = padded.reshape(len(values), -1, steps, *values.shape[2:])
        return jnp.moveaxis(chunks, 0, 2)

    def chunk_loss(net, state, chunk: Window):
        def step(state, now):
            x, delta, weight = now
            state, prediction = net(state, x)
            return state, (weight * jnp.square(prediction - delta).mean(-1)).sum()

        state, errors = jax.lax.scan(step, state, (chunk.x, chunk.delta, chunk.weight))
        return errors.sum() / total, state

    def go_on(carry, chunk: Window):
        state, loss, grads = carry
        found, more = jax.value_and_grad(chunk_loss, has_aux=True)(net, state, chunk)
        return (found[1], loss + found[0], jax.tree.map(jnp.add, grads, more)), None

    nothing = net.start(len(batch.weight)), jnp.zeros(()), jax.tree.map(jnp.zeros_like, net)
    (_, loss, grads), _ = jax.lax.scan(go_on, nothing, Window(*map(chunked, batch)))
    return loss, grads


@jit_networks
def recurrent_epoch(
    state: FitState, setup: FitSetup, data: FitData, *, key: PRNGKeyArray
) -> tuple[FitState, EpochStats]:
    """Go once through all episodes, in batches of whole ones, at least one of them.

    Args:
        state: Network and optimiser.
        setup: Task and settings.
        data: The data set, with its normalisers.
        key: Shuffles the episodes.
    """
    episodes, config = data.episodes, setup.config
    capacity, length = episodes.action.shape[:2]
    size = episodes_per_update(config.batch_size, length)
    draws = jax.random.uniform(key, (capacity,))
    order = jnp.argsort(jnp.where(jnp.arange(capacity) < episodes.count, draws, jnp.inf))
    order = jnp.pad(order, (0, -capacity % size))
    steps = min(config.backprop_steps, length)

    def update(i, state):
        chosen = jax.lax.dynamic_slice_in_dim(order, i * size, size)
        counted = i * size + jnp.arange(size) < episodes.count
        batch = window(setup.task, data, chosen, jnp.zeros_like(chosen), length)
        batch = batch._replace(weight=batch.weight * counted[:, None])
        loss, grads = batch_gradient(state.model, batch, steps)
        state, skipped = state.step(loss, grads, config.learning_rate)
        return state, loss, loss, skipped

    return run_updates(state, -(-episodes.count // size), update)


def episodes_per_update(batch_size: int, length: int) -> int:
    """Whole episodes, padded to a length, that fill a batch."""
    return max(1, batch_size // length)


class ReBAL(Model):
    """A recurrent network, whose state is what it remembers of the episode."""

    net: RecurrentNet
    statistics: Statistics
    task: Task

    def init_belief(self, num_envs: int, sim_params: None = None) -> tuple[CellState, ...]:
        """See `Model.init_belief`."""
        return self.net.start(num_envs)

    def observe(
        self, belief: tuple[CellState, ...], transition: Transition, keys: Keys
    ) -> tuple[CellState, ...]:
        """See `Model.observe`; the state goes on by the action that was taken."""
        x = network_input(self.task, self.statistics, transition.obs, transition.action)
        after, _ = self.net(belief, x)
        return where_env(transition.happened, after, belief)

    def dynamics(
        self, belief: tuple[CellState, ...], precision: Precision = "float32"
    ) -> "RecurrentDynamics":
        """See `Model.dynamics`."""
        layers = plan_layers((*self.net.layers, self.net.output), precision)
        return RecurrentDynamics(belief, self.statistics, self.task, layers)


class RecurrentDynamics(PlainDynamics):
    """A recurrent network whose state goes on with every imagined step."""

    own: tuple[CellState, ...]
    layers: tuple[Layer, ...]

    def start(self) -> tuple[CellState, ...]:
        """See `Dynamics.start`."""
        return jax.tree.map(lambda x: x[None], self.own)

    def step(self, carry, obs, action, noise):
        """See `Dynamics.step`."""
        x = self.wide_input(obs, action)
        *layers, output = self.layers
        states = []
        for layer, before in zip(layers, carry, strict=True):
            gates = layer(jnp.concatenate([x, before.hidden], axis=1))
            states.append(next_cell(before, gates, axis=1))
            x = states[-1].hidden
        return tuple(states), self.next_obs(obs, output(x))
