"""Cores that share the candidates of a plan choose what one program would choose; their noise."""

import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import toys
from headway.config import CEMConfig, ICEMConfig, RandomShootingConfig
from headway.planning import cpu
from headway.planning.controller import Controller
from headway.planning.cpu import Shard, in_shards

OBS = np.random.default_rng(2).normal(size=(3, 2)).astype(np.float32)


def make_agent(**settings):
    settings = {"num_particles": 4, **settings}
    return toys.make_agent(toys.small_model(seed=3), **settings)


@pytest.fixture
def sharing(monkeypatch):
    """Plans of any size are shared by three cores."""
    monkeypatch.setattr(cpu, "LEAST_STEPS", 1)
    monkeypatch.setattr(cpu, "num_cpus", lambda: 3)


@pytest.mark.parametrize(
    ("caches", "settings"),
    [
        (1, {"reward": "released", "selection_error": "sampled", "selection_skips_newest": True}),
        (2**20, {"num_candidates": 2, "optimizer": CEMConfig(num_elites=1)}),  # side by side
        (1, {"num_candidates": 41, "precision": "bfloat16"}),
        (2**20, {"num_candidates": 41, "num_particles": 1, "particle_noise": "none"}),
        *(
            pytest.param(caches, {"optimizer": optimizer}, marks=pytest.mark.slow)
            for caches, optimizer in [
                (1, ICEMConfig(num_elites=4)),  # environments in turns
                (2**20, RandomShootingConfig()),
            ]
        ),
    ],
    ids=str,
)
def test_cores_that_share_a_plan_choose_the_actions_of_one_program(
    caches, settings, sharing, monkeypatch
):
    monkeypatch.setattr(cpu, "CACHES_OF_CORE", caches)
    agent = make_agent(**settings)
    plain, timed = Controller(agent), Controller(agent, deadline_ms=1e7)
    walks = {n: toys.walk(agent, n) for n in (2, 4)}  # shards of candidates, of environments
    in_time = [timed.act(obs) for obs in OBS]
    assert timed.status.outcome == "planned"
    monkeypatch.setattr(cpu, "LEAST_STEPS", np.inf)
    for num_envs, walk in walks.items():
        np.testing.assert_allclose(walk, toys.walk(agent, num_envs), atol=1e-5)
    np.testing.assert_allclose(in_time, [plain.act(obs) for obs in OBS], atol=1e-4)


def test_number_of_shards(monkeypatch):
    monkeypatch.setattr(cpu, "num_cpus", lambda: 4)
    monkeypatch.setattr(cpu, "LEAST_STEPS", 100)
    assert [cpu.num_shards(100 * n) for n in (0, 1, 2, 3, 4, 5, 100)] == [1, 1, 2, 3, 4, 4, 4]
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert cpu.num_shards(10_000) == 1


def test_a_step_that_is_part_of_another_program_is_one_program(sharing):
    agent = make_agent()
    state = agent.init(1, key=jax.random.key(0))
    keys = jax.random.split(jax.random.key(1), 2)

    def action(key):
        return agent.act(state._replace(key=key), OBS[:1])[1].action

    found = jax.vmap(action)(keys)
    np.testing.assert_allclose(found, [action(key) for key in keys], atol=1e-5)


def test_environments_are_spread_evenly_over_chunks_that_fit():
    sizes = [cpu.environments_at_once(10, size, budget=100) for size in (10, 11, 30, 1000)]
    assert sizes == [10, 5, 3, 1]


def test_shards_do_not_wait_for_threads_that_are_busy(monkeypatch):
    free = threading.Event()
    with ThreadPoolExecutor(1) as busy:
        monkeypatch.setattr(cpu, "_threads", lambda: busy)
        busy.submit(free.wait, 60)
        found = in_shards(lambda shard: jnp.full((1, shard.size), 1.0 * shard.first), (1, 6), 3)
        assert not free.is_set()
        free.set()
    np.testing.assert_array_equal(np.concatenate(found, 1), [[0, 0, 2, 2, 4, 4]])


def test_an_error_in_another_thread_is_raised(monkeypatch):
    together = threading.Barrier(2)

    def fails_elsewhere(shard: Shard):
        together.wait(60)
        if threading.current_thread() is not threading.main_thread():
            raise ZeroDivisionError
        return jnp.zeros((1, shard.size))

    with ThreadPoolExecutor(1) as threads:
        monkeypatch.setattr(cpu, "_threads", lambda: threads)
        with pytest.raises(ZeroDivisionError):
            in_shards(fails_elsewhere, (1, 4), 2)


IN_THREADS = """
import sys, threading, numpy as np
from concurrent.futures import ThreadPoolExecutor
from headway.planning import cpu
from planning.test_cpu import make_agent, toys
cpu.LEAST_STEPS, cpu.num_cpus = 1, lambda: 3
plan = lambda seed: toys.walk(make_agent(), 1, int(sys.argv[1]), seed)
wanted = [plan(seed) for seed in range(3)]
with ThreadPoolExecutor(3) as threads:
    print([np.array_equal(*pair) for pair in zip(threads.map(plan, range(3)), wanted)])
def late():
    threading.main_thread().join()
    print(toys.walk(make_agent(), 1, 2).shape)
threading.Thread(target=late).start()
"""


@pytest.mark.parametrize("plans", [30, pytest.param(2_000, marks=pytest.mark.slow)])
def test_controllers_in_several_threads_share_the_cores_and_may_outlive_the_main_one(plans):
    paths = [str(Path(toys.__file__).parent), *sys.path]
    done = subprocess.run(
        [sys.executable, "-c", IN_THREADS, str(plans)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True,
        text=True,
        timeout=max(240, plans),
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout.split("\n") == ["[True, True, True]", "(2, 1, 2)", ""]
