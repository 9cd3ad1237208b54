"""Let a controller serve for very many steps: memory, traces, deadlines kept.

    python benchmarks/soak.py --steps 1000000
    python benchmarks/soak.py --steps 1000000 --deadline-ms 20

The world is a pendulum's Task with an untrained model of a few units: what is tested is the
service, not the control. `--minutes` stops it earlier. Prints a line of JSON per report and one
at the end, which says how long a million steps would take at the same pace. Linux.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np

from headway.errors import PlanningError
from headway.planning import agent as agent_module
from headway.planning.controller import Controller
from headway.training.loading import initial, learner_of, load_task
from headway.training.methods import make_config

REPORTS = 20
WARM_UP = 2000
"""Steps before anything is counted; they compile, and let memory settle."""
TINY = {
    "model.num_members": 1,
    "model.hidden_sizes": (8,),
    "model.context_hidden_sizes": (8,),
    "model.backward_net": False,
    "planner.num_particles": 1,
    "planner.num_candidates": 10,
    "planner.optimizer.num_elites": 2,
    "planner.horizon": 5,
    "planner.num_iterations": 2,
}


def main() -> None:
    parser = argparse.ArgumentParser(description="Let a controller serve for very many steps.")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--deadline-ms", type=float, default=None)
    parser.add_argument("--minutes", type=float, default=float("inf"))
    asked = parser.parse_args()
    print(json.dumps(soak(asked.steps, asked.deadline_ms, asked.minutes)))


def soak(steps: int, deadline_ms: float | None, minutes: float = float("inf")) -> dict:
    """Serve, and say what it took.

    Args:
        steps: How many.
        deadline_ms: The controller's; None for none.
        minutes: After which no further part of the steps is begun.
    """
    traces = count_traces()
    controller = Controller(tiny_agent(), deadline_ms=deadline_ms)
    serve(controller, WARM_UP)
    seconds = np.full(steps, np.nan, np.float32)  # this memory is taken before it is measured
    memory, traces_before, started = [resident()], len(traces), time.perf_counter()
    outcomes: dict[str, int] = {}
    done, part = 0, max(1, steps // REPORTS)
    while done < steps and time.perf_counter() - started < 60 * minutes:
        number = min(part, steps - done)
        seconds[done : done + number] = serve(controller, number, outcomes)
        done += number
        memory.append(resident())
        print(json.dumps({"steps": done, "resident_mib": memory[-1] / 2**20}), flush=True)
    taken = (time.perf_counter() - started) / 60
    half = memory[len(memory) // 2]
    facts = {
        "steps": done,
        "deadline_ms": deadline_ms,
        "outcomes": outcomes,
        "grown_mib": (memory[-1] - memory[0]) / 2**20,
        "grown_in_second_half_mib": (memory[-1] - half) / 2**20,
        "live_arrays": len(jax.live_arrays()),
        "new_traces": len(traces) - traces_before,
        "milliseconds": {
            name: float(1000 * np.quantile(seconds[:done], share))
            for name, share in (("median", 0.5), ("99%", 0.99), ("99.9%", 0.999), ("longest", 1.0))
        },
        "minutes": taken,
        "minutes_per_million": taken / done * 1e6,
    }
    if deadline_ms:
        facts["late"] = int((1000 * seconds[:done] > deadline_ms).sum())
    return facts


def tiny_agent():
    """An untrained agent that plans in a fraction of a millisecond."""
    config = make_config("pendulum", preset="smoke", settings=TINY)
    task = load_task(config)
    return learner_of(config, task).agent(initial(config, task))


def count_traces() -> list[int]:
    """Grows with every trace of a step."""
    traces: list[int] = []
    original = agent_module.observe

    def encode(*parts):
        traces.append(1)
        return original(*parts)

    agent_module.observe = encode
    return traces


def serve(controller: Controller, steps: int, outcomes: dict[str, int] | None = None):
    """Act on random observations, some of them not finite, with a reset now and then."""
    rng, seconds = np.random.default_rng(0), np.zeros(steps, np.float32)
    for step in range(steps):
        angle, speed = rng.normal(size=2)
        obs = np.array([np.cos(angle), np.sin(angle), speed])
        if step % 500 == 0:
            controller.reset()
        elif step % 97 == 3:
            obs[step % 3] = np.nan
        outcome = "stopped"
        try:
            controller.act(obs)
            status = controller.status
            assert status is not None
            outcome, seconds[step] = status.outcome, status.seconds
        except PlanningError:  # no sight, and nothing left of the plan
            controller.reset()
        if outcomes is not None:
            outcomes[outcome] = outcomes.get(outcome, 0) + 1
    return seconds


def resident() -> int:
    """Bytes of memory that the process holds now, without mapped files."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return 1024 * int(next(line for line in lines if line.startswith("RssAnon")).split()[1])


if __name__ == "__main__":
    main()
