"""Copy what is worth committing of some runs: settings, tables and the newest manifest.

    python results/keep.py results/pendulum-quick runs/reproduce/runs/pendulum/*/seed*
    python results/keep.py results/NAME RUN ... --settings collection.episode_length=500

The settings are those that all runs of the folder share, so that they name no arm. There are no
checkpoints and no data in a copy: `headway report` reads it, no run goes on from it.
"""

import argparse
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from headway import config as settings
from headway.config import Config
from headway.lab.sweep import fingerprint
from headway.storage.iterations import manifest_name
from headway.training.methods import make_config
from headway.training.run import TABLES, RunDir


def keep(run: RunDir, folder: Path, shared: Mapping[str, Any] | None = None) -> Path:
    """Copy one run to `ARM/seed-N`.

    Args:
        run: A finished run.
        folder: Where the runs of one comparison go.
        shared: Settings that all of them have.
    """
    config = run.config()
    if run.finished_iterations < config.collection.num_iterations:
        raise SystemExit(f"{run.path} is not finished; the command that began it resumes it.")
    kept = folder / arm(config, shared or {}) / f"seed-{config.seed}"
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


def arm(config: Config, shared: Mapping[str, Any]) -> str:
    """The method, and what makes a run another arm of it: its head selection, or a fingerprint."""
    usual = make_config(config.env, method=config.method, preset=config.preset, settings=shared)
    selection = config.planner.head_selection
    other_selection = settings.override(usual, {"planner.head_selection": selection})
    own = fingerprint(config)
    if own == fingerprint(usual):
        return config.method
    if own == fingerprint(other_selection):
        return f"{config.method}-{selection}"
    return f"{config.method}-{own}"


def main() -> None:
    """Copy the runs, and say where to."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="where the runs of one comparison go")
    parser.add_argument("runs", type=Path, nargs="+", help="finished runs")
    parser.add_argument("--settings", nargs="+", default=[], metavar="NAME=JSON")
    asked = parser.parse_args()
    named = (text.partition("=") for text in asked.settings)
    shared = {name: json.loads(value) for name, _, value in named}
    for path in asked.runs:
        print(keep(RunDir(path), asked.folder, shared))


if __name__ == "__main__":
    main()
