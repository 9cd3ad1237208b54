"""How well heads predict after they have learned, on training physics that the run never saw.

    python results/adaptation/held_out.py RUN --others OTHER_SEED ... --epochs 10 --table NAME.csv

Goes on from a finished run with epochs of training for adaptation, exactly as the run would have
with `fitting.adaptation_epochs`, and measures before and after each some. What is held out are the
episodes that other seeds collected under training physics; nothing unseen is looked at. With
`--plain` the epochs lack the adaptation loss, to tell what mere further training does.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from headway.config import override
from headway.data import Episodes, Trajectory
from headway.experiment.learners import Learned, make_learner
from headway.experiment.learners import multi_headed as learners
from headway.experiment.loading import load_learned, load_task
from headway.experiment.training import Keys
from headway.models.multi_headed import MultiHeadDynamics, Statistics
from headway.planning.last_layer import training
from headway.planning.last_layer.regression import see_episode
from headway.storage.records import write_csv
from headway.storage.run_dir import RunDir
from headway.task import episode_length

MOMENTS = (1, 3, 10, 30, 100)
"""Transitions that are learned from before the next are predicted."""
AHEAD = 20
"""Transitions that are predicted; the quick preset plans as many."""
COLUMNS = ("run", "loss", "step", "epoch", "rank", "learned_from", "rmse", "nll")


class Held(NamedTuple):
    """Errors after learning, averaged over members and held-out episodes."""

    rmse: np.ndarray
    """[moment, rank]; root of the mean squared error, normalised."""
    nll: np.ndarray
    """[moment, rank]; the loss that is trained for, but of the next transitions only."""


@eqx.filter_jit
def of_moment(
    model: MultiHeadDynamics,
    statistics: Statistics,
    loss: training.AdaptationLoss,
    episodes: Episodes,
    moment: training.Moment,
) -> tuple[jax.Array, jax.Array]:
    """Mean squared error [member, rank] and NLL [member, rank] of what follows a moment."""
    steps = jnp.arange(episodes.action.shape[1])
    learned = steps < moment.step
    end = jnp.minimum(moment.step + AHEAD, episodes.length[moment.episode])
    judged = ~learned & (steps < end)
    context = jnp.where(learned, steps + 1, moment.step)
    seen = see_episode(
        model, loss.task, statistics, episodes, moment.episode, context, loss.history_length
    )
    residual = training.of_best_heads(seen.residual)

    def of_rank(features, residual, ratio):
        what = features, residual[:, None]
        left, _ = training.errors_after_learning(*what, moment.step, ratio)
        nll = training.loss_after_learning(*what, moment.step, judged, ratio)
        return (jnp.square(left).mean((1, 2)) * judged).sum() / judged.sum(), nll

    of_member = jax.vmap(of_rank, in_axes=(None, 1, None))
    features = loss.prior.even(seen.features)
    return jax.vmap(of_member, in_axes=(1, 1, 0))(features, residual, loss.prior.ratio)


def measure(
    learned: Learned, loss: training.AdaptationLoss, held_out: Sequence[Trajectory]
) -> Held:
    """Learn from the beginning of every held-out episode, and predict what follows."""
    longest = max(len(trajectory) for trajectory in held_out)
    episodes = Episodes.pad(list(held_out), len(held_out), longest)
    rmse, nll = [], []
    for step in MOMENTS:
        found = [
            of_moment(
                learned.fit.model,
                learned.statistics,
                loss,
                episodes,
                training.Moment(jnp.asarray(row), jnp.asarray(step)),
            )
            for row in range(len(held_out))
        ]
        squared, losses = (np.stack(column) for column in zip(*found, strict=True))
        rmse.append(np.sqrt(squared.mean((0, 1))))
        nll.append(losses.mean((0, 1)))
    return Held(np.stack(rmse), np.stack(nll))


def plain_fit(state: Any, setup: Any, blocks: Any, *, independent: bool, extra: Any = None) -> Any:
    """`fit_blocks` without the adaptation loss."""
    del extra
    return _FIT(state, setup, blocks, independent=independent)


_FIT = learners.fit_blocks


def main() -> None:
    """Train for adaptation, and measure."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path, help="directory of a finished run")
    parser.add_argument("--others", type=Path, nargs="+", required=True, help="runs of other seeds")
    parser.add_argument("--epochs", type=int, default=20)
    parser.add_argument("--every", type=int, default=5, help="epochs between two measurements")
    parser.add_argument("--step", type=float, default=training.STEP, help="share of the step size")
    parser.add_argument("--plain", action="store_true", help="without the adaptation loss")
    parser.add_argument("--episodes", type=int, default=10, help="held out, of each other run")
    parser.add_argument(
        "--criterion", default="foresight", choices=["foresight", "likelihood"], help="of the prior"
    )
    parser.add_argument("--table", type=Path, help="CSV file to write")
    asked = parser.parse_args()
    training.STEP = asked.step
    learners.fit_blocks = plain_fit if asked.plain else _FIT
    run = RunDir(asked.run)
    settings = {
        "fitting.adaptation_epochs": asked.epochs,
        "planner.adaptation_criterion": asked.criterion,
    }
    config = override(run.config(), settings)
    held_out = [
        trajectory
        for other in asked.others
        for trajectory in RunDir(other).load_data()[-asked.episodes :]
    ]
    learner = make_learner(config, load_task(config), episode_length(config))
    assert isinstance(learner, learners.MultiHeaded)
    learned, data = load_learned(run, config), run.load_data()
    last = config.collection.num_iterations - 1
    fit = learner.fit(data, last, Keys.of(config.seed, last).fit)
    name = f"{asked.run.parent.name}-{asked.run.name}"
    rows: list[dict[str, Any]] = []

    def note(epoch: int, learned: Learned) -> None:
        found = measure(learned, learner.adaptation_loss(learned, data), held_out)
        kind = "plain" if asked.plain else "adaptation"
        for moment, rmse, nll in zip(MOMENTS, found.rmse, found.nll, strict=True):
            for rank, head in enumerate(("owner", "runner-up")[: len(rmse)]):
                row = dict(
                    zip(COLUMNS, (name, kind, asked.step, epoch, head, moment), strict=False)
                )
                rows.append(row | {"rmse": float(rmse[rank]), "nll": float(nll[rank])})
                print(*rows[-1].values(), flush=True)

    note(0, learned)
    for epoch, (state, stats) in enumerate(fit.epochs(learned.fit, config.fitting.epochs), 1):
        print(f"epoch {epoch}: loss {stats.loss:.3f}, ordinary {stats.forward_loss:.3f}")
        if epoch % asked.every == 0 or epoch == asked.epochs:
            note(epoch, Learned(state, fit.statistics))
    if asked.table:
        write_csv(asked.table, COLUMNS, rows)


if __name__ == "__main__":
    main()
