"""Summarise runs of one environment: returns and scores per physics, over seeds.

python results/summarise.py results/pendulum-quick/tmcl/seed-*
"""

import sys
from collections import defaultdict
from pathlib import Path

import numpy as np

from headway.config import Config
from headway.storage.records import read_csv
from headway.training.references import score_of
from headway.training.run import EVALUATION_COLUMNS, EpisodeRow, RunDir, format_sim_params

Means = dict[tuple[bool, str], tuple[float, float]]
"""Return and score by physics, which is unseen or not."""


def last_rows(run_dir: Path, name: str = "evaluation.csv") -> list[EpisodeRow]:
    """Test episodes after the last iteration of a run."""
    table = read_csv(run_dir / name, EVALUATION_COLUMNS)
    rows = [EpisodeRow.from_csv(row) for row in table]
    last = max(row.iteration for row in rows)
    return [row for row in rows if row.iteration == last]


def mean_by_physics(rows: list[EpisodeRow], config: Config) -> Means:
    """Mean return and mean score (NaN where unknown) of each physics."""
    found = defaultdict(list)
    for row in rows:
        value = score_of(row, config)
        place = row.group != "train", format_sim_params(row.sim_params)
        found[place].append((row.episode_return, np.nan if value is None else value))
    return {place: tuple(np.mean(values, axis=0)) for place, values in found.items()}


def of_run(run_dir: Path) -> Means:
    """`mean_by_physics` of a run's last tests."""
    return mean_by_physics(last_rows(run_dir), RunDir(run_dir).config())


def main(run_dirs: list[str]) -> None:
    """Print one line per physics, then the means over training and unseen physics."""
    runs = [of_run(Path(run_dir)) for run_dir in run_dirs]
    print("physics | return of each run | score of each run | mean score")
    for place in sorted(runs[0]):
        returns, scores = zip(*(run[place] for run in runs), strict=True)
        print(line(("unseen " if place[0] else "") + place[1], returns, scores))
    for unseen in (False, True):
        pairs = [np.mean([v for p, v in run.items() if p[0] == unseen], axis=0) for run in runs]
        returns, scores = zip(*pairs, strict=True)
        print(line(f"mean over {'unseen' if unseen else 'training'} physics", returns, scores))


def line(name: str, returns: tuple[float, ...], scores: tuple[float, ...]) -> str:
    """One row of the table."""
    cells = [" ".join(f"{v:.0f}" for v in returns), " ".join(f"{v:.2f}" for v in scores)]
    return " | ".join([name, *cells, f"{np.mean(scores):.2f}"])


if __name__ == "__main__":
    main(sys.argv[1:])
