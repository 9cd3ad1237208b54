"""Copy what is worth committing of some runs: settings and tables, no checkpoints and no data.

python results/keep.py results/pendulum-quick runs/reproduce/runs/pendulum/*/seed*
"""

import shutil
import sys
from pathlib import Path

from headway.experiment.methods import make_config
from headway.storage.run_dir import RunDir
from headway.storage.tables import TABLES


def keep(run: RunDir, folder: Path) -> Path:
    """Copy one run to `METHOD/seed-N`, with what makes it another arm of its method in the name.

    Args:
        run: A finished run.
        folder: Where the runs of one comparison go.
    """
    config = run.config()
    if run.finished_iterations < config.collection.num_iterations:
        raise SystemExit(f"{run.path} is not finished; the command that began it resumes it.")
    selection = config.planner.head_selection
    usual = make_config(config.env, method=config.method, preset=config.preset)
    own = selection == usual.planner.head_selection
    arm = config.method if own else f"{config.method}-{selection}"
    kept = folder / arm / f"seed-{config.seed}"
    kept.mkdir(parents=True, exist_ok=True)
    for name in ("config.json", *TABLES):
        shutil.copyfile(run.path / name, kept / name)
    return kept


if __name__ == "__main__":
    for path in sys.argv[2:]:
        print(keep(RunDir(path), Path(sys.argv[1])))
