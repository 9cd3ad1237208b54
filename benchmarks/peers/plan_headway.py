"""Seconds that Headway takes for plans of the paper's HalfCheetah size."""

import argparse
import json
import sys
import time
from pathlib import Path

import jax

sys.path.insert(0, str(Path(__file__).parents[1]))
from workloads import make_agent, planners

from headway.training.methods import make_config


def main() -> None:
    """Print the seconds of each plan as a JSON list, after one that is not counted."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--method", default="tmcl")
    parser.add_argument("--precision", default="float32", choices=list(planners()))
    parser.add_argument("--num-envs", type=int, default=1)
    parser.add_argument("--plans", type=int, default=3)
    arguments = parser.parse_args()
    model = make_config("half-cheetah", method=arguments.method).model
    planner = planners()[arguments.precision]
    agent, state, obs = make_agent(arguments.num_envs, model, planner)

    def plan() -> float:
        start = time.perf_counter()
        jax.block_until_ready(agent.act(state, obs))
        return time.perf_counter() - start

    print(json.dumps([plan() for _ in range(arguments.plans + 1)][1:]))


if __name__ == "__main__":
    main()
