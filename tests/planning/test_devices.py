"""Plans on several devices, in reduced precision, in chunks, and ten thousand times."""

import dataclasses
import json
import os
import subprocess
import sys
from pathlib import Path

import jax
import numpy as np
import pytest

import toys
from headway.config import CEMConfig, PlannerConfig
from headway.planning import devices
from headway.planning.agent import Agent

TINY = PlannerConfig(
    horizon=5,
    num_candidates=40,
    optimizer=CEMConfig(num_elites=8),
    num_iterations=3,
    num_particles=4,
)


def make_agent(**settings):
    planner = dataclasses.replace(TINY, **settings)
    model = toys.small_model(seed=3)
    return Agent(model, toys.identity_statistics(), toys.POINT, planner, 3)


def actions(agent, num_envs=3, steps=3):
    state = agent.init(num_envs, key=jax.random.key(0))
    obs = np.random.default_rng(1).normal(size=(steps, num_envs, 2)).astype(np.float32)
    found = []
    for one in obs:
        state, decision = agent.act(state, one)
        found.append(np.asarray(decision.action))
    return np.stack(found)


def python(program, *args):
    """A Python that can import what the tests can.

    XLA gets more threads than there are devices: with fewer its collectives can wait for good.
    """
    paths = [str(Path(toys.__file__).parent), *sys.path]
    return subprocess.Popen(
        [sys.executable, "-c", program, *args],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths), "NPROC": "8"},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


PROGRAM = """
import json, sys, jax
jax.config.update("jax_num_cpu_devices", int(sys.argv[1]))
from planning import test_devices
assert len(jax.devices()) == int(sys.argv[1])
agent = test_devices.make_agent(**json.loads(sys.argv[2]))
print(json.dumps(test_devices.actions(agent).tolist()))
state, _ = agent.act(agent.init(1, key=jax.random.key(0)), [[0.0, 0.0]])
print(len(state.search.guess.sharding.device_set))
"""


@pytest.mark.parametrize(
    "settings",
    [
        {},
        pytest.param({"particle_noise": "shared"}, marks=pytest.mark.slow),
        {"num_candidates": 42},
    ],
)
def test_four_devices_choose_the_actions_of_one(settings):
    (one, num_one), (four, num_four) = (on_devices(number, settings) for number in (1, 4))
    assert (num_one, num_four) == (1, 4)
    np.testing.assert_allclose(four, one, atol=1e-5)


def on_devices(number, settings):
    """The actions of an agent on some simulated devices, and how many its state lies on."""
    out = printed_by(python(PROGRAM, str(number), json.dumps(settings)))
    found, num_devices = out.splitlines()[-2:]
    return np.array(json.loads(found)), int(num_devices)


def printed_by(worker, seconds=120):
    """What a Python has printed once it has ended well, in time."""
    try:
        out, errors = worker.communicate(timeout=seconds)
    finally:
        worker.kill()
    assert worker.returncode == 0, errors[-2000:]
    return out


COMPILED_PROGRAM = """
import jax
jax.config.update("jax_num_cpu_devices", 2)
from planning import test_devices
compiled = []
def listen(event, seconds, **rest):
    compiled.append(event) if event.endswith("backend_compile_duration") else None
jax.monitoring.register_event_duration_secs_listener(listen)
agent = test_devices.make_agent()
state, _ = agent.act(agent.init(1, key=jax.random.key(0)), [[0.0, 0.0]])
print(len(compiled) > 0)
compiled.clear()
for _ in range(3):
    state, _ = agent.act(state, [[0.0, 0.0]])
print(len(compiled))
"""


def test_devices_that_share_a_plan_compile_it_once():
    assert printed_by(python(COMPILED_PROGRAM)).split() == ["True", "0"]


def test_reduced_precision_chooses_nearly_the_same_actions():
    exact, reduced = (
        actions(make_agent(), steps=8),
        actions(make_agent(precision="bfloat16"), steps=8),
    )
    assert not np.array_equal(exact, reduced)
    difference = np.abs(exact - reduced)
    other_seed = np.abs(exact - actions(make_agent(num_candidates=41), steps=8))
    assert np.median(difference) < 0.02
    assert difference.max() < 0.15
    assert np.median(difference) < 0.3 * np.median(other_seed)


def test_environments_are_spread_evenly_over_chunks_that_fit(monkeypatch):
    monkeypatch.setattr(devices, "activation_budget", lambda: 100)
    assert devices.environments_at_once(10, 10) == 10
    assert devices.environments_at_once(10, 11) == 5
    assert devices.environments_at_once(10, 30) == 3
    assert devices.environments_at_once(10, 1000) == 1


def test_the_budget_of_a_gpu_follows_its_free_memory():
    stats = {"bytes_limit": 16 * 2**30, "bytes_in_use": 8 * 2**30}
    assert devices.memory_budget("gpu", stats) == 2**30
    assert devices.memory_budget("gpu", None) == devices.CPU_BUDGET
    assert devices.memory_budget("cpu", stats) == devices.CPU_BUDGET


def resident_kib():
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS"))


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize("plans", [2_000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_thousands_of_plans_take_no_more_memory(plans):
    agent = make_agent(
        num_candidates=8,
        optimizer=CEMConfig(num_elites=2),
        num_iterations=1,
        num_particles=2,
        horizon=2,
    )
    state = agent.init(1, key=jax.random.key(0))
    obs = np.zeros((1, 2), np.float32)
    resident = []
    for step in range(plans):
        state, decision = agent.act(state, obs)
        if step % (plans // 10) == plans // 10 - 1:
            jax.block_until_ready(decision)
            resident.append(resident_kib())
    assert max(resident[1:]) - resident[1] < 8 * 2**10
