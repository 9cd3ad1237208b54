"""One step of ten HalfCheetah environments at once, against ten steps one at a time."""

import statistics
import time

import gymnasium
import numpy as np

from headway import envs

NUM_ENVS = 10
STEPS = 50  # of each environment per round, to time more than the clock's grain


def test_vector_step(benchmark, report):
    shape = (NUM_ENVS, 6)
    actions = np.random.default_rng(0).uniform(-1, 1, shape).astype(np.float32)
    vector = envs.make_vec("half-cheetah", NUM_ENVS, episode_length=10_000)
    vector.reset(seed=0)
    benchmark.pedantic(vector.step, args=(actions,), rounds=20, iterations=STEPS, warmup_rounds=1)
    together = 1e3 * benchmark.stats.stats.median
    vector.close()

    singles = [gymnasium.make("headway/HalfCheetah-v0") for _ in range(NUM_ENVS)]
    for seed, single in enumerate(singles):
        single.reset(seed=seed)
    one_by_one = 1e3 * statistics.median(single_step_seconds(singles, actions) for _ in range(20))
    report.add(f"{NUM_ENVS} single steps", one_by_one, "ms")
    report.add(
        f"vector step of {NUM_ENVS} HalfCheetahs",
        together,
        "ms",
        ratio=together / one_by_one,
        ratio_to=f"{NUM_ENVS} single steps",
    )


def single_step_seconds(singles: list[gymnasium.Env], actions: np.ndarray) -> float:
    """Seconds that one step of every environment takes, in turn."""
    start = time.perf_counter()
    for _ in range(STEPS):
        for single, action in zip(singles, actions, strict=True):
            single.step(action)
    return (time.perf_counter() - start) / STEPS
