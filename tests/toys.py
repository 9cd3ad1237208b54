"""Tiny tasks, data and exactly known models that the tests of the core share."""

import dataclasses
import functools
from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np

from headway.config import CEMConfig, FittingConfig, MultiHeadedConfig, PlannerConfig
from headway.data import Episodes, Samples, Trajectory, where_env
from headway.models.fitting import FitSetup, make_data
from headway.models.multi_headed import MultiHeadModel, MultiHeadNet
from headway.models.networks import Dense, GaussianNet
from headway.models.statistics import Statistics
from headway.planning.agent import Agent
from headway.task import Task


class PointTask(Task):
    """Two numbers pushed by two forces; the reward wants the state at zero, cheaply."""

    obs_size: ClassVar[int] = 2
    action_size: ClassVar[int] = 2
    action_low: ClassVar[tuple[float, ...]] = (-1.0, -1.0)
    action_high: ClassVar[tuple[float, ...]] = (1.0, 1.0)

    def reward(self, obs, action, next_obs):
        return -jnp.square(next_obs).sum(-1) - 0.1 * jnp.square(action).sum(-1)


class ScaledTask(PointTask):
    """Actions of other units, extra features and a termination, to leave nothing at identity."""

    action_low: ClassVar[tuple[float, ...]] = (-2.0, 0.0)
    action_high: ClassVar[tuple[float, ...]] = (2.0, 3.0)

    def reward(self, obs, action, next_obs):
        return obs[..., 0] + 2.0 * next_obs[..., 1] - 0.3 * action[..., 0] + action[..., 1]

    def released_reward(self, obs, action, next_obs):
        return obs[..., 0]

    def terminated(self, obs, action, next_obs):
        return next_obs[..., 0] > 1.0

    def preprocess(self, obs):
        return jnp.concatenate([obs[..., :1], jnp.sin(obs[..., 1:]), jnp.cos(obs[..., 1:])], -1)


SMALL = MultiHeadedConfig(
    num_members=2,
    num_heads=2,
    hidden_sizes=(8, 8),
    context_size=3,
    context_hidden_sizes=(6,),
    history_length=3,
)
TINY = PlannerConfig(
    horizon=4,
    num_candidates=60,
    optimizer=CEMConfig(num_elites=10),
    num_iterations=4,
    num_particles=2,
    selection_length=2,
)
POINT = PointTask()


def random_trajectory(steps, seed=0, gain=1.0, *, constant=False):
    """`obs' = obs + gain * action` under random actions; `constant` freezes the second number."""
    rng = np.random.default_rng(seed)
    action = rng.uniform(-1, 1, (steps, 2)).astype(np.float32)
    pushed = gain * action * [1.0, 0.0 if constant else 1.0]
    obs = rng.normal(size=2) + np.concatenate([np.zeros((1, 2)), np.cumsum(pushed, axis=0)])
    return Trajectory(
        obs.astype(np.float32), action, np.zeros(steps, np.float32), {"gain": float(gain)}
    )


def lay_out(trajectories, *, max_length=None, capacity=None, future_length=2, sample_capacity=None):
    """Episodes and samples of some trajectories, padded by a little at least."""
    lengths = [len(t) for t in trajectories]
    count = sum(min(future_length, length - t) for length in lengths for t in range(length))
    episodes = Episodes.pad(trajectories, capacity or len(lengths) + 1, max_length or max(lengths))
    return episodes, Samples.table(lengths, future_length, sample_capacity or count + 3)


def make_setup(history_length=3, **settings):
    return FitSetup(POINT, FittingConfig(**settings), history_length)


def fit_data(trajectories, setup, *, members=2, statistics=None, **layout):
    """All that an epoch reads; normalisers are fitted by default."""
    layout = {"future_length": setup.config.future_length} | layout
    episodes, samples = lay_out(trajectories, **layout)
    if statistics is None:
        statistics = Statistics.fit(POINT, trajectories, setup.history_length)
    key = jax.random.key(9)
    return make_data(episodes, samples, statistics, setup.config, num_members=members, key=key)


def small_model(seed=0, task=POINT, config=SMALL):
    """A random model whose biases and variance bounds are not at their initial values either."""
    rng = np.random.default_rng(seed)
    names = ("gain", "drag") if config.context == "sim-params" else ()
    shapes = jax.eval_shape(
        lambda key: MultiHeadNet.init(config, task, sim_param_names=names, key=key),
        jax.random.key(0),
    )

    def draw(path, leaf):
        bound = {"max_logvar": 0.5, "min_logvar": -10.0}.get(path[-1].name, 0.0)
        spread = 0.5 if path[-1].name == "weight" else 0.2
        return jnp.asarray(bound + spread * rng.normal(size=leaf.shape), jnp.float32)

    return jax.tree_util.tree_map_with_path(draw, shapes)


def linear_model(gains):
    """A deterministic model that is exactly `delta = action @ gain`, with no context.

    One hidden layer of x and -x, because swish(x) - swish(-x) = x.

    Args:
        gains: [member, head, action, obs].
    """
    gains = np.asarray(gains, np.float32)
    members, heads, action_size, obs_size = gains.shape
    size = obs_size + action_size
    twice = np.concatenate([np.eye(size), -np.eye(size)], axis=1).astype(np.float32)
    full = np.concatenate([np.zeros((members, heads, obs_size, obs_size)), gains], axis=2)
    hidden = Dense(jnp.asarray(np.tile(twice, (members, 1, 1))), jnp.zeros((members, 2 * size)))
    weight = jnp.asarray(np.concatenate([full, -full], axis=2), jnp.float32)
    mean_heads = Dense(weight, jnp.zeros((members, heads, obs_size)))
    return MultiHeadNet(GaussianNet((hidden,), mean_heads, None, None, None), None, None)


UP_DOWN = linear_model([[np.eye(2), -np.eye(2)], [-np.eye(2), np.eye(2)]])


def with_noise(net, stds):
    """A deterministic network of one member whose heads have noise of known deviations."""
    logvar = 2 * jnp.log(jnp.asarray(stds))[None, :, None]
    bias = jnp.broadcast_to(logvar, net.mean_heads.bias.shape)
    shape = net.mean_heads.bias.shape[1:]
    heads = Dense(jnp.zeros(net.mean_heads.weight.shape), bias)
    return GaussianNet(
        net.hidden, net.mean_heads, heads, jnp.full(shape, 20.0), jnp.full(shape, -60.0)
    )


def predict(net, x, context=None):
    """A network's prediction, samples before features."""
    columns = net(x.mT, None if context is None else context.mT)
    return jax.tree.map(lambda values: values.mT, columns)


def make_agent(net=UP_DOWN, planner=TINY, *, statistics=None, task=POINT, prior=None, **settings):
    """An agent that acts with some networks; further settings change the planner's."""
    planner = dataclasses.replace(planner, **settings)
    statistics = statistics or identity_statistics(task)
    return Agent(MultiHeadModel(net, statistics, task, planner, 3, prior), task, planner)


def walk(agent, num_envs=3, steps=3, seed=0):
    """The agent's actions, [step, env, ...], when it sees random observations."""
    state, found = agent.init(num_envs, key=jax.random.key(seed)), []
    observed = np.random.default_rng(1).normal(size=(steps, num_envs, 2)).astype(np.float32)
    for obs in observed:
        state, decision = agent.act(state, obs)
        found.append(np.asarray(decision.action))
    return np.stack(found)


def reset_where(state, fresh, done):
    """Begin a new episode in some environments."""
    kept = where_env(done, fresh._replace(key=None), state._replace(key=None))
    return kept._replace(key=state.key)


def identity_statistics(task=POINT, history_length=3):
    return Statistics.identity(task, history_length)


def odd_statistics(task=POINT, history_length=3, seed=5, sim_param_names=()):
    """Normalisers that shift and scale everything differently."""
    rng = np.random.default_rng(seed)

    def odd(like):
        shift, scale = rng.normal(size=like.shape), rng.uniform(0.5, 2.0, like.shape)
        return jnp.asarray(scale if (like == 1).all() else shift, jnp.float32)

    return jax.tree.map(odd, Statistics.identity(task, history_length, sim_param_names))


def softplus(x):
    return np.logaddexp(0.0, x)


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def assert_equal(first, second):
    jax.tree.map(np.testing.assert_array_equal, first, second)


def assert_close(first, second, rtol=1e-4, atol=1e-6):
    close = functools.partial(np.testing.assert_allclose, rtol=rtol, atol=atol)
    jax.tree.map(close, first, second)


def assert_finite(tree):
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(tree))


def f64(tree):
    """The same tree in NumPy's float64, for twins."""
    return jax.tree.map(lambda x: np.asarray(x, np.float64), tree)
