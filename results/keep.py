"""Copy what is worth committing of some runs: settings, tables and the newest manifest.

python results/keep.py results/pendulum-quick runs/reproduce/runs/pendulum/*/seed*

There are no checkpoints and no data in a copy: `headway report` reads it, no run goes on from it.
"""

import shutil
import sys
from pathlib import Path

from headway import settings
from headway.config import Config
from headway.experiment.methods import make_config
from headway.storage.iterations import manifest_name
from headway.storage.run_dir import RunDir
from headway.storage.tables import TABLES
from headway.sweeps.jobs import fingerprint


def keep(run: RunDir, folder: Path) -> Path:
    """Copy one run to `ARM/seed-N`.

    Args:
        run: A finished run.
        folder: Where the runs of one comparison go.
    """
    config = run.config()
    if run.finished_iterations < config.collection.num_iterations:
        raise SystemExit(f"{run.path} is not finished; the command that began it resumes it.")
    kept = folder / arm(config) / f"seed-{config.seed}"
    if (kept / "config.json").exists():
        other = settings.differences(RunDir(kept).config(), config)
        if other:
            raise SystemExit(f"{kept} is of another run ({'; '.join(other)}); choose a folder.")
    manifest = run.manifest()
    names = ["config.json", *TABLES, *([manifest_name(manifest.iteration)] if manifest else [])]
    for name in names:
        (kept / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(run.path / name, kept / name)
    return kept


def arm(config: Config) -> str:
    """The method, and what makes a run another arm of it: its head selection, or a fingerprint."""
    usual = make_config(config.env, method=config.method, preset=config.preset)
    selection = config.planner.head_selection
    other_selection = settings.override(usual, {"planner.head_selection": selection})
    own = fingerprint(config)
    if own == fingerprint(usual):
        return config.method
    if own == fingerprint(other_selection):
        return f"{config.method}-{selection}"
    return f"{config.method}-{own}"


if __name__ == "__main__":
    for path in sys.argv[2:]:
        print(keep(RunDir(path), Path(sys.argv[1])))
