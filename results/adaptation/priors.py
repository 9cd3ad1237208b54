"""Print the prior that empirical Bayes chooses for trained runs, per member.

python results/adaptation/priors.py runs/pendulum-0 runs/pendulum-1
"""

import sys

import numpy as np

from headway.experiment.loading import load_agent
from headway.experiment.methods import config_to_evaluate
from headway.storage.run_dir import RunDir


def main(run_dirs: list[str]) -> None:
    """One line per run and form of the noise: ratio of every member, noise of every dimension."""
    print("run | noise | prior from | ratio of each member | noise std of each dimension")
    for run_dir in run_dirs:
        run = RunDir(run_dir)
        for noise in ("constant", "heads"):
            for rank in ("owner", "runner-up"):
                settings = {
                    "planner.adaptation": "last-layer",
                    "planner.adaptation_noise": noise,
                    "planner.adaptation_prior": rank,
                }
                prior = load_agent(run, config_to_evaluate(run.config(), settings)).prior
                assert prior is not None
                ratios = " ".join(f"{ratio:.0e}" for ratio in np.asarray(prior.ratio))
                std = " ".join(f"{x:.4f}" for x in np.sqrt(np.asarray(prior.noise)).mean(0))
                print(run.path.name, noise, rank, ratios, std, sep=" | ")


if __name__ == "__main__":
    main(sys.argv[1:])
