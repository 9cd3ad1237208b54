"""A reward and an end of episodes that the networks predict."""

import dataclasses

import equinox as eqx
import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import headway
import toys
from headway import task
from headway.config import PlannerConfig
from headway.errors import ConfigError
from headway.models.base import Transition
from headway.models.folding import fold
from headway.models.statistics import Normalizer, network_input
from headway.planning.rollouts import candidate_returns
from headway.training.check import check
from headway.training.progress import make_progress

LEARNED = dataclasses.replace(toys.SMALL, learned_reward=True)
PHYSICS = {"train": {"push": [0.5, 1.0]}}


class Blank(toys.PointTask):
    """Says nothing about reward and end."""

    reward = headway.Task.reward


@pytest.fixture
def known():
    reward = Normalizer(jnp.array([3.0]), jnp.array([2.0]))
    statistics = dataclasses.replace(toys.odd_statistics(), reward=reward)
    return toys.small_model(config=LEARNED), statistics


def test_a_rollout_earns_what_the_heads_predict_until_they_predict_an_end(known):
    net, statistics = known
    rng = np.random.default_rng(0)
    obs, candidates = rng.normal(size=(1, 2)), rng.uniform(-1, 1, (1, 30, 4, 2))
    heads, context = [1, 0], rng.normal(size=(2, 1, 3)).astype(np.float32)
    learned = 0.1 * rng.normal(size=(1, 2, 2, 12, 2))  # by the last layer, of 8 + 3 + 1 features
    dynamics = fold(
        net.forward_net,
        statistics,
        Blank(),
        jnp.asarray(heads)[None, :, None],
        jnp.asarray(context),
        correction=jnp.asarray(learned),
    )
    planner = PlannerConfig(num_particles=2, particle_noise="none")
    args = dynamics, Blank(), jnp.asarray(obs), jnp.asarray(candidates)
    found = candidate_returns(*args, planner=planner, key=jax.random.key(0))
    expected, ended = np.zeros(30), 0
    for member, candidate in np.ndindex(2, 30):
        x, alive, head = obs[0].astype(np.float32), True, heads[member]
        for action in candidates[0, candidate]:
            pair = jnp.asarray(x[None]), jnp.asarray(action[None])
            row = network_input(Blank(), statistics, *pair)
            row, about = (jnp.broadcast_to(r, (2, 1, r.shape[-1])).mT for r in (row, context))
            features = net.forward_net.head_input(row, about)
            mean = np.asarray(net.forward_net.predict(features).mean)[member, head, :, 0]
            delta, reward, logit = np.split(mean, [2, 3])
            seen = np.append(np.asarray(features)[member, :, 0], 1.0)
            delta = jnp.asarray(delta + seen @ learned[0, member, head])
            expected[candidate] += alive * (3.0 + 2.0 * reward[0]) / 2
            alive, ended = alive and logit[0] <= 0, ended + (alive and logit[0] > 0)
            x = x + np.asarray(statistics.delta.denormalize(delta))
    assert 5 < ended < 55  # both happen
    np.testing.assert_allclose(found[0], expected, rtol=2e-4, atol=2e-4)


def test_heads_are_chosen_and_corrected_by_observations_alone(known):
    net, statistics = known
    planner = dataclasses.replace(toys.TINY, num_particles=2)
    agent = toys.make_agent(net, planner, statistics=statistics, task=Blank())
    biases = net.forward_net.mean_heads.bias
    other = eqx.tree_at(
        lambda net: net.forward_net.mean_heads.bias, net, biases.at[..., 2:].add(9.0)
    )
    same = toys.make_agent(other, planner, statistics=statistics, task=Blank())
    obs, action = np.random.default_rng(2).normal(size=(2, 5, 2)).astype(np.float32)
    seen = Transition(*map(jnp.asarray, (obs, np.tanh(action), obs + action, np.ones(5, bool))))
    keys = jax.random.split(jax.random.key(0))
    chosen = [
        one.model.observe(one.model.init_belief(5), seen, keys).heads for one in (agent, same)
    ]
    np.testing.assert_array_equal(*chosen)
    residual = net.residuals(Blank(), statistics, seen[:3], jnp.zeros((2, 5, 3))).residual
    assert residual.shape == (5, 2, 2, 2)


class Pushed(gymnasium.Env):
    """A number that is pushed about; it should be near 0.5, and an episode ends beyond ±2."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (1,), np.float64)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.push = (options or {}).get("sim_params", {}).get("push", 1.0)
        self.state = self.np_random.uniform(-1.9, 1.9, size=1)
        return self.state.copy(), {"sim_params": {"push": self.push}}

    def step(self, action):
        self.state = self.state + self.push * np.asarray(action)
        reward = 100.0 - 10.0 * float(self.state[0] - 0.5) ** 2
        return self.state.copy(), reward, bool(np.abs(self.state[0]) > 2), False, {}


def test_an_environment_alone_is_enough_and_its_reward_and_end_are_learned(
    tmp_path, monkeypatch, capsys
):
    monkeypatch.setattr(task, "_registered", {})
    settings = {"collection.episode_length": 25, "collection.num_episodes": 40}
    settings |= {"model.num_heads": 1, "fitting.min_updates": 1500, "fitting.batch_size": 128}
    settings |= {"model.hidden_sizes": (32, 32), "model.history_length": 2}
    settings |= {"planner.selection_length": 2, "collection.min_steps": 600}
    run = headway.train(
        Pushed,
        sim_params=PHYSICS,
        preset="smoke",
        run_dir=tmp_path / "run",
        settings=settings,
        progress=make_progress(quiet=False),
    )
    assert "reward and end of episodes are learned" in capsys.readouterr().err
    assert run.config.model.learned_reward
    agent = run.controller().agent
    belief = agent.model.init_belief(1)
    dynamics = agent.model.dynamics(belief)
    one = dynamics.of_env(jax.tree.map(lambda x: x[0], dynamics.own))
    obs = np.linspace(-1.9, 1.9, 39).astype(np.float32)

    def outcome(push):
        rows = jnp.broadcast_to(obs, (one.num_members, 1, 1, 39))
        after, _ = one.step(one.start(), rows, jnp.full_like(rows, push), None)
        return (np.asarray(x)[:, 0].mean(0) for x in one.outcome(after))

    reward, ended = outcome(0.0)
    np.testing.assert_allclose(reward, 100 - 10 * np.square(obs - 0.5), atol=8)
    assert not ended[np.abs(obs) < 1.1].any()
    _, ended = outcome(1.0)
    assert not ended[obs < 0.3].any()
    assert ended[obs > 1.5].all()
    sets = headway.SimParamSets(**PHYSICS)
    rows = check(headway.EnvSpec(env_id=Pushed, sim_params=sets, episode_length=25))
    assert {row.name for row in rows if row.status == "fault"} == set()
    assert "learns" in next(row.text for row in rows if row.name == "Task.reward")


def test_what_no_model_of_a_method_can_learn_is_said_at_once(tmp_path, monkeypatch):
    monkeypatch.setattr(task, "_registered", {})
    about = {"sim_params": PHYSICS, "preset": "smoke", "run_dir": tmp_path / "run"}
    about["settings"] = {"collection.episode_length": 25}
    with pytest.raises(ConfigError, match=r"has no reward, and rebal learns none, allowed: a"):
        headway.train(Pushed, method="rebal", **about)
    assert not (tmp_path / "run").exists()
    with pytest.raises(ConfigError, match="Blank has no reward"):
        Blank().reward(jnp.zeros(2), jnp.zeros(2), jnp.zeros(2))
