"""Train a finished run for adaptation, without training it again.

    python results/adaptation/go_on.py RUN NEW_RUN --epochs 10

NEW_RUN is what the run would have become with `fitting.adaptation_epochs`, but untested: these
epochs follow the last fit, so everything before them is copied. On one and the same machine the
networks are those of `headway train ... --fitting.adaptation-epochs 10`, to the bit.
"""

import argparse
import shutil
from collections.abc import Mapping
from pathlib import Path

from headway.config import Config, override
from headway.experiment.learners import Learned, make_learner
from headway.experiment.loading import load_learned, load_task
from headway.experiment.training import Keys
from headway.models.fitting import EpochStats
from headway.storage import arrays, config_file, files
from headway.storage.iterations import checkpoint_name, manifest_name
from headway.storage.manifest import Digest, Manifest
from headway.storage.run_dir import RunDir
from headway.task import episode_length


def copy_but_last_fit(old: RunDir, new: Path, config: Config) -> None:
    """Copy a finished run with other settings, as it was before its last iteration was finished."""
    last = config.collection.num_iterations - 1
    if old.finished_iterations != last + 1 or last == 0:
        raise SystemExit(f"{old.path} is not finished, or has one iteration; two are needed.")
    shutil.copytree(old.path, new)
    (new / manifest_name(last)).unlink()
    (new / checkpoint_name(last)).unlink()
    files.write_bytes(new / "config.json", config_file.content(config))
    place = new / manifest_name(last - 1)
    before = Manifest.read(place)
    known = {**before.files, "config.json": Digest.of(new / "config.json")}
    Manifest(before.iteration, known).write(place)


def go_on(old: RunDir, config: Config) -> tuple[Learned, EpochStats]:
    """The epochs of training for adaptation that follow the last fit of a run."""
    learner = make_learner(config, load_task(config), episode_length(config))
    last = config.collection.num_iterations - 1
    fit = learner.fit(old.load_data(), last, Keys.of(config.seed, last).fit)
    reached = None
    for reached in fit.epochs(load_learned(old, config).fit, config.fitting.epochs):
        print("loss", reached[1].loss, "ordinary", reached[1].forward_loss, flush=True)
    if reached is None:
        raise SystemExit("there was no epoch to train for adaptation: the model has no heads.")
    state, stats = reached
    return Learned(state, fit.statistics), stats


def finish(
    old: RunDir, new: RunDir, learned: Learned, losses: Mapping[str, float] | None = None
) -> None:
    """Write the last iteration of the new run, which was not tested."""
    rows = old.metrics()
    last = len(rows) - 1
    fitting = {**rows[last]["fitting"], **(losses or {})}
    arrays.save_tree(new.checkpoint(last), learned)
    new.append_evaluation([])
    new.append_assignments([])
    new.append_prediction_errors([])
    new.append_metrics([{**rows[last], "fitting": fitting, "evaluation": {}}])
    new.finish(last)


def main() -> None:
    """Copy, go on, write."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path, help="directory of a finished run")
    parser.add_argument("new", type=Path, help="directory to make")
    parser.add_argument("--epochs", type=int, required=True)
    asked = parser.parse_args()
    old = RunDir(asked.run)
    config = override(old.config(), {"fitting.adaptation_epochs": asked.epochs})
    copy_but_last_fit(old, asked.new, config)
    learned, stats = go_on(old, config)
    losses = {"loss": float(stats.loss), "forward_loss": float(stats.forward_loss)}
    finish(old, RunDir(asked.new), learned, losses)


if __name__ == "__main__":
    main()
