"""Contract of every model: what it remembers, forgets, adapts to and imagines."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import GradientAdaptedConfig, RecurrentConfig
from headway.models.base import RecentTransitions, Transition
from headway.models.grbal import GrBAL, ReluNet, Window, adapt
from headway.models.multi_headed import MultiHeadModel
from headway.models.rebal import ReBAL, RecurrentNet
from headway.models.statistics import network_input
from headway.planning.agent import Agent
from headway.planning.controller import Controller
from headway.planning.rollouts import candidate_returns
from headway.training.diagnostics import imagine

TASK = toys.ScaledTask()
SIZES = (6, 5)
PLANNER = dataclasses.replace(toys.TINY, num_particles=1)
KINDS = ["multi-headed", "gradient", "recurrent"]
KEYS = jax.random.split(jax.random.key(0))
YES = jnp.ones(2, bool)

close = functools.partial(toys.assert_close, atol=1e-5)


@functools.cache
def model_of(kind):
    statistics, key = toys.odd_statistics(TASK), jax.random.key(0)
    if kind == "gradient":
        net = ReluNet.init(GradientAdaptedConfig(hidden_sizes=SIZES), TASK, key=key)
        return GrBAL(net, statistics, TASK, 3, 0.1)
    if kind == "recurrent":
        net = RecurrentNet.init(RecurrentConfig(hidden_sizes=SIZES), TASK, key=key)
        return ReBAL(net, statistics, TASK)
    config = dataclasses.replace(toys.SMALL, num_members=1, deterministic=True)
    return MultiHeadModel(toys.small_model(0, TASK, config), statistics, TASK, PLANNER, 3)


@pytest.fixture(params=KINDS)
def model(request):
    return model_of(request.param)


def transitions(count, num_envs=2, seed=0):
    rng = np.random.default_rng(seed)
    obs = rng.normal(size=(count + 1, num_envs, 2)).astype(np.float32)
    action = rng.uniform(-1, 1, (count, num_envs, 2)).astype(np.float32)
    return [
        Transition(*map(jnp.asarray, (obs[t], action[t], obs[t + 1])), YES) for t in range(count)
    ]


@eqx.filter_jit
def lived(model, steps, keys):
    belief = model.init_belief(len(steps[0].obs))
    for step in steps:
        belief = model.observe(belief, step, keys)
    return belief


def live(model, steps):
    return lived(model, steps, KEYS)


@eqx.filter_jit
def step_of(model, belief, obs, action):
    """The next observation that `dynamics` predicts, per environment."""
    dynamics = model.dynamics(belief)

    def one(part, obs, action):
        one = dynamics.of_env(part)
        carry = jax.tree.map(lambda x: x[..., None, None], one.start())
        wide = obs[None, :, None, None], action[None, :, None, None]
        return one.step(carry, *wide, None)[1][0, :, 0, 0]

    return jax.vmap(one)(dynamics.own, obs, action)


def predicted(net, statistics, obs, action):
    x = network_input(TASK, statistics, obs, action)
    return TASK.postprocess(obs, statistics.delta.denormalize(net(x)))


def test_weights_are_adapted_to_the_last_transitions_of_each_environment():
    model, steps = model_of("gradient"), transitions(5)
    now = steps[0]
    found = step_of(model, live(model, steps), now.obs, now.action)
    for env in range(2):
        newest = [jnp.stack([one[i][env] for one in steps[-3:]]) for i in range(3)]
        past = Window.of(TASK, model.statistics, tuple(newest), jnp.ones(3))
        net = adapt(model.net, past, 0.1)
        close(
            found[env],
            predicted(net, model.statistics, now.obs[env][None], now.action[env][None])[0],
        )
    plain = predicted(model.net, model.statistics, now.obs, now.action)
    assert np.abs(found - plain).min() > 1e-5
    close(step_of(model, live(model, steps[:2]), now.obs, now.action), plain)  # not enough yet


def test_a_recurrent_state_goes_on_by_what_was_observed_and_done():
    model, steps = model_of("recurrent"), transitions(4)
    belief, state, now = live(model, steps), model.net.start(2), steps[0]
    for step in steps:
        x = network_input(TASK, model.statistics, step.obs, step.action)
        state, _ = model.net(state, x)
    close(belief, state)
    wanted = predicted(lambda x: model.net(state, x)[1], model.statistics, now.obs, now.action)
    close(step_of(model, belief, now.obs, now.action), wanted)


def test_what_did_not_happen_is_not_remembered(model):
    steps = transitions(4)
    before = live(model, steps[:3])
    after = model.observe(before, steps[3]._replace(happened=jnp.array([True, False])), KEYS)
    obs, action = steps[0][:2]
    old, new = (step_of(model, belief, obs, action) for belief in (before, after))
    np.testing.assert_array_equal(old[1], new[1])
    assert (old[0] != new[0]).any()


def test_returns_are_those_of_steps_taken_one_by_one(model):
    belief, rng = live(model, transitions(5)), np.random.default_rng(2)
    obs = jnp.asarray(rng.normal(size=(2, 2)), jnp.float32)
    candidates = jnp.asarray(rng.uniform(-1, 1, (2, 4, 3, 2)), jnp.float32)
    found = candidate_returns(
        model.dynamics(belief), TASK, obs, candidates, planner=PLANNER, key=KEYS[0]
    )
    for env, candidate in ((0, 0), (0, 3), (1, 1)):
        state, now, total, alive = belief, obs, 0.0, True
        for step in range(3):
            action = jnp.broadcast_to(candidates[env, candidate, step], (2, 2))
            after = step_of(model, state, now, action)
            paid = TASK.reward(now, TASK.scale_action(action), after)[env]
            total += float(paid) if alive else 0.0
            alive = alive and not bool(TASK.terminated(now, action, after)[env])
            if isinstance(model, ReBAL):  # imagined steps go into the state, but change no weights
                state = model.observe(state, Transition(now, action, after, YES), KEYS)
            now = after
        np.testing.assert_allclose(found[env, candidate], total, rtol=1e-4, atol=1e-4)


def test_an_agent_learns_from_its_steps_and_begins_every_episode_anew(model):
    agent = Agent(model, TASK, PLANNER)
    observed = np.random.default_rng(0).normal(size=(6, 2, 2)).astype(np.float32)

    def play():
        state, actions = agent.init(2, key=jax.random.key(0)), []
        for obs in observed:
            state, decision = agent.act(state, obs)
            actions.append(np.asarray(decision.action))
        return state, np.stack(actions)

    state, actions = play()
    steps = zip(observed[:-1], actions[:-1], observed[1:], strict=True)
    steps = [Transition(*map(jnp.asarray, step), YES) for step in steps]
    close(state.belief, live(model, steps))
    np.testing.assert_array_equal(play()[1], actions)  # nothing is left of the first episode
    toys.assert_equal(agent.init(2, key=jax.random.key(0)).belief, model.init_belief(2))


def test_imagining_lives_through_the_past_first(model):
    steps = transitions(5)
    slots = [jnp.stack([step[i] for step in steps], 1) for i in range(3)]
    actions = jnp.asarray(np.random.default_rng(4).uniform(-1, 1, (2, 2, 2)), jnp.float32)
    young = RecentTransitions(*slots, jnp.array([5, 3]))
    found = imagine(model, young, actions, KEYS)[0][0, :, 0]
    for env, count in ((0, 5), (1, 3)):
        belief = live(model, steps[5 - count :])
        close(found[env], step_of(model, belief, steps[-1].next_obs, actions[:, 0])[env])


def test_bfloat16_products_stay_close(model):
    steps = transitions(5)
    belief, obs, candidates = live(model, steps), steps[0].obs, steps[0].action[:, None, None]
    exact, coarse = (
        candidate_returns(
            model.dynamics(belief, precision), TASK, obs, candidates, planner=PLANNER, key=KEYS[0]
        )
        for precision in ("float32", "bfloat16")
    )
    assert 0 < np.abs(exact - coarse).max() < 0.1


def test_a_deadline_that_is_long_enough_changes_nothing_and_odd_observations_are_named(model):
    agent = Agent(model, TASK, PLANNER)
    plain, timed = Controller(agent), Controller(agent, deadline_ms=1e6)
    for step in range(3):
        obs = np.array([0.1 * step, -0.2])
        np.testing.assert_allclose(timed.act(obs), plain.act(obs), atol=1e-5)
        assert timed.status.outcome == "planned"
    timed.act(np.full(2, 1e4))
    assert timed.status.outcome == "planned"
    assert timed.status.warnings
