"""Let a controller serve for very many steps: memory, traces, deadlines kept.

    python benchmarks/soak.py --steps 1000000 --deadline-ms 20

The world is a pendulum's Task with an untrained model of the `smoke` preset: what is tested is
the service, not the control. Prints a line of JSON per report and one at the end. Linux.
"""

import argparse
import json
import time
from pathlib import Path

import jax
import numpy as np

from headway.errors import PlanningError
from headway.experiment.loading import initial, learner_of, load_task
from headway.experiment.methods import make_config
from headway.planning import agent as agent_module
from headway.planning.controller import Controller

REPORTS = 20


def main() -> None:
    parser = argparse.ArgumentParser(description="Let a controller serve for very many steps.")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--deadline-ms", type=float, default=None)
    parser.add_argument("--candidates", type=int, default=20)
    asked = parser.parse_args()
    traces = count_traces()
    controller = Controller(small_agent(asked.candidates), deadline_ms=asked.deadline_ms)
    serve(controller, 2000)  # compiles, and lets memory settle
    before, traces_before, started = resident(), len(traces), time.perf_counter()
    outcomes: dict[str, int] = {}
    seconds = np.zeros(asked.steps, np.float32)
    for done in range(0, asked.steps, max(1, asked.steps // REPORTS)):
        steps = min(asked.steps // REPORTS or 1, asked.steps - done)
        seconds[done : done + steps] = serve(controller, steps, outcomes)
        print(json.dumps({"steps": done + steps, "resident_mib": resident() / 2**20}), flush=True)
    facts = {
        "steps": asked.steps,
        "deadline_ms": asked.deadline_ms,
        "outcomes": outcomes,
        "grown_mib": (resident() - before) / 2**20,
        "live_arrays": len(jax.live_arrays()),
        "new_traces": len(traces) - traces_before,
        "milliseconds": {
            name: float(1000 * np.quantile(seconds, share))
            for name, share in (("median", 0.5), ("99%", 0.99), ("99.9%", 0.999), ("longest", 1.0))
        },
        "minutes": (time.perf_counter() - started) / 60,
    }
    if asked.deadline_ms:
        facts["late"] = int((1000 * seconds > asked.deadline_ms).sum())
    print(json.dumps(facts))


def small_agent(num_candidates: int):
    """An agent that plans in well under a millisecond on any machine of today."""
    settings = {
        "planner.num_candidates": num_candidates,
        "planner.num_elites": max(1, num_candidates // 5),
        "planner.horizon": 5,
    }
    config = make_config("pendulum", preset="smoke", settings=settings)
    task = load_task(config)
    return learner_of(config, task).agent(initial(config, task))


def count_traces() -> list[int]:
    """Grows with every trace of a step."""
    traces: list[int] = []
    original = agent_module.encode

    def encode(*parts):
        traces.append(1)
        return original(*parts)

    agent_module.encode = encode
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
