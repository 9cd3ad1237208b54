"""What heads that keep learning add to one plan, at the paper's HalfCheetah sizes."""

import time

import equinox as eqx
import jax
import jax.numpy as jnp
import pytest
from workloads import make_agent

from headway.config import PlannerConfig
from headway.planning.agent import encode
from headway.planning.last_layer.learning import learn
from headway.planning.last_layer.regression import Prior

ROUNDS = 3
ARMS = {
    "constant noise": {},
    "noise of the heads": {"adaptation_noise": "heads"},
    "forgetting": {"forgetting": 0.01},
    "variance in the plan": {"adaptation_variance": True},
}


@pytest.mark.parametrize(("num_envs", "arm"), [*((1, arm) for arm in ARMS), (10, "constant noise")])
def test_plan_with_heads_that_learn(num_envs, arm, report):
    """Frozen and learning heads take turns, and the least time of each counts."""
    planner = PlannerConfig(adaptation="last-layer", **ARMS[arm])
    frozen = make_agent(num_envs)
    learning = make_agent(num_envs, planner=planner, prior=some_prior())
    for agent, state, obs in (frozen, learning):
        jax.block_until_ready(agent.act(state, obs))
    seconds = {"frozen": [], "learning": []}
    for _ in range(ROUNDS):
        for name, (agent, state, obs) in (("frozen", frozen), ("learning", learning)):
            start = time.perf_counter()
            jax.block_until_ready(agent.act(state, obs))
            seconds[name].append(time.perf_counter() - start)
    added = min(seconds["learning"]) / min(seconds["frozen"]) - 1.0
    report.add(f"last layer, {arm}, {num_envs} env: added to a plan", 100.0 * added, "%")
    memory = sum(x.nbytes for x in jax.tree.leaves(learning[1].learned)) / 2**20
    report.add(f"last layer, {arm}, {num_envs} env: memory", memory, "MiB")


@pytest.mark.parametrize("arm", ARMS)
def test_learning_from_one_transition(arm, timed, report):
    """The update alone, without the plan."""
    planner = PlannerConfig(adaptation="last-layer", **ARMS[arm])
    agent, state, obs = make_agent(10, planner=planner, prior=some_prior())
    recent = state.recent.push(obs, state.action, obs, jnp.ones(10, bool))
    once = eqx.filter_jit(learn)
    args = state.learned, recent, encode(agent, recent), jnp.ones(10, bool)
    timing = timed(lambda: once(agent, *args), rounds=20)
    report.add(f"last layer, {arm}, 10 env: one update", timing.seconds, "s")


def some_prior() -> Prior:
    """A prior of the paper's ensemble for HalfCheetah."""
    return Prior(jnp.full(5, 1.0), jnp.full((5, 18), 0.01), jnp.zeros(5))
