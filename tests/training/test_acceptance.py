"""What the project promises of its quick preset; takes minutes."""

from collections import defaultdict

import numpy as np
import pytest

import headway
from headway.training.references import score


@pytest.mark.slow
def test_quick_pendulum_masters_its_training_physics_and_separates_them(tmp_path):
    run = headway.train("pendulum", preset="quick", seed=0, run_dir=tmp_path / "run")
    scores = defaultdict(list)
    for row in run.evaluation:
        if row.group == "train":
            value = score(row.env, row.sim_params, row.episode_return, row.length)
            scores[row.sim_params["length"]].append(value)
    assert np.mean([np.mean(values) for values in scores.values()]) >= 0.9

    last = len(run.metrics) - 1
    rows = [r for r in headway.RunDir(run.path).assignments() if r["iteration"] == last]
    for member in range(run.config.model.num_members):
        shares = defaultdict(dict)
        for row in rows:
            if row["member"] == member:
                shares[row["sim_params"]][row["head"]] = row["share"]
        owners = {max(heads, key=heads.__getitem__) for heads in shares.values()}
        purity = np.mean([max(heads.values()) for heads in shares.values()])
        assert len(owners) >= 2
        assert purity >= 0.7
