"""Several seeds in one program against the same seeds one after another.

    python benchmarks/seeds_together.py            3 and 10 seeds
    python benchmarks/seeds_together.py 2 4        as many as these

The two take turns in one process, and the fastest of their turns are compared, so the ratio
holds on a busy machine too. Below 1 the seeds gain by going together. Networks and planner are
those of the growth curves, and of the presets `smoke` and `quick` in HalfCheetah.
"""

import sys
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
from growth_axes import FITTING, MODEL, NUM_ENVS, PLANNER
from reporting import markdown_table
from workloads import make_agent, make_fit

from headway.experiment.methods import make_config
from headway.models.fitting import fit_epoch
from headway.models.meeting import Meeting

ROUNDS = 7
EPISODES = 2

Work = Callable[[], Any]


def compare(work: Work, num_seeds: int) -> tuple[float, float]:
    """Least seconds of the work of all seeds: one after another, and together."""
    meeting, gate = Meeting(), threading.Barrier(num_seeds + 1)
    apart, together = [], []

    def sit(seat: Any) -> None:
        with seat:
            for _ in range(ROUNDS):
                gate.wait()
                jax.block_until_ready(work())
                gate.wait()

    seats = [meeting.take_seat() for _ in range(num_seeds)]
    with ThreadPoolExecutor(num_seeds) as pool:
        for seat in seats:
            pool.submit(sit, seat)
        for _ in range(ROUNDS):  # the first one compiles, and is never the fastest
            start = time.perf_counter()
            jax.block_until_ready([work() for _ in range(num_seeds)])
            between = time.perf_counter()
            gate.wait()
            gate.wait()
            apart.append(between - start)
            together.append(time.perf_counter() - between)
    return min(apart), min(together)


def works() -> dict[str, Work]:
    """What is compared: a plan, and an epoch, at several sizes."""
    sizes: dict[str, Any] = {"growth": (NUM_ENVS, MODEL, PLANNER)}
    for preset in ("smoke", "quick"):
        config = make_config("half-cheetah", preset=preset)
        sizes[preset] = (config.collection.num_episodes, config.model, config.planner)
    found: dict[str, Work] = {}
    for name, (num_envs, model, planner) in sizes.items():
        found[f"plan, {name}"] = plan_of(num_envs, model, planner)
        if name != "quick":  # takes minutes without a GPU
            found[f"epoch, {name}"] = epoch_of(model)
    return found


def plan_of(num_envs: int, model: Any, planner: Any) -> Work:
    agent, state, obs = make_agent(num_envs, model, planner)
    return lambda: agent.act(state, obs)


def epoch_of(model: Any) -> Work:
    """One epoch over a few episodes, heads assigned."""
    state, setup, data = make_fit(EPISODES, EPISODES, model, FITTING)
    key = jax.random.key(2)
    return lambda: fit_epoch(state, setup, data, independent=False, key=key)


def main() -> None:
    """Measure and print a table."""
    numbers = [int(word) for word in sys.argv[1:]] or [3, 10]
    rows = []
    for name, work in works().items():
        for seeds in numbers:
            apart, together = compare(work, seeds)
            cells = [f"{1e3 * apart:.3g}", f"{1e3 * together:.3g}", f"{together / apart:.2f}"]
            rows.append([name, str(seeds), *cells])
            print(*rows[-1], flush=True)
    columns = ["work", "seeds", "one after another, ms", "together, ms", "ratio"]
    print(markdown_table(columns, rows))


if __name__ == "__main__":
    main()
