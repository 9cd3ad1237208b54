"""Take away the heads of a finished run that own little of every training physics.

    python results/adaptation/prune.py RUN NEW_RUN --min-share 0.1

NEW_RUN is the same run, untested, with these heads gone: each becomes a copy of the head of its
member that owns most, so that whichever of the two is chosen, the same mean is planned with.
(Bounds of the variance belong to a place, not to a member, and stay.) Labels of physics only
name the shares, as in `assignments.csv`; heads were made without them.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from go_on import copy_but_last_fit, finish
from jaxtyping import Float, Int

from headway.experiment.learners import Learned
from headway.models.multi_headed import MultiHeadDynamics
from headway.training.loading import load_learned
from headway.training.run import RunDir

Shares = Float[np.ndarray, "member head physics"]


def shares(run: RunDir) -> Shares:
    """What each head owns of each training physics after the last fit."""
    rows = run.assignments()
    rows = [row for row in rows if row["iteration"] == rows[-1]["iteration"]]
    physics = sorted({row["sim_params"] for row in rows})
    sizes = [1 + max(row[name] for row in rows) for name in ("member", "head")]
    found = np.zeros((*sizes, len(physics)))
    for row in rows:
        place = row["member"], row["head"], physics.index(row["sim_params"])
        found[place] = row["share"]
    return found


def replacements(owned: Shares, min_share: float) -> Int[np.ndarray, "member head"]:
    """Which head of its member stands in each place: itself, or the one that owns most."""
    kept = owned.max(-1) >= min_share
    most = owned.mean(-1).argmax(-1)[:, None]
    return np.where(kept, np.arange(owned.shape[1]), most)


def replaced(model: MultiHeadDynamics, heads: Int[np.ndarray, "member head"]) -> MultiHeadDynamics:
    """The model with other heads of the same members in some places."""
    net, member = model.forward_net, np.arange(len(heads))[:, None]

    def places(net: Any) -> Sequence[Any]:
        layers = [net.mean_heads, net.logvar_heads]
        return [x for layer in layers if layer is not None for x in (layer.weight, layer.bias)]

    moved = [jnp.asarray(x)[member, heads] for x in places(net)]
    return eqx.tree_at(lambda model: places(model.forward_net), model, moved)


def main() -> None:
    """Copy, prune, write; tells how many heads of each member are left."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("run", type=Path, help="directory of a finished run")
    parser.add_argument("new", type=Path, help="directory to make")
    parser.add_argument("--min-share", type=float, default=0.1, help="of some training physics")
    asked = parser.parse_args()
    old = RunDir(asked.run)
    config = old.config()
    heads = replacements(shares(old), asked.min_share)
    learned = load_learned(old, config)
    model = replaced(learned.fit.model, heads)
    copy_but_last_fit(old, asked.new, config)
    fit = eqx.tree_at(lambda fit: fit.model, learned.fit, model)
    finish(old, RunDir(asked.new), Learned(fit, learned.statistics))
    print("heads left:", *(len(set(row)) for row in heads.tolist()))


if __name__ == "__main__":
    main()
