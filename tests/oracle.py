"""The oracle of the rebuilding: numbers of every method at tiny sizes, kept in `oracle.json`.

    python tests/oracle.py            # compare with oracle.json, to 1e-5; exits 1 where one differs
    python tests/oracle.py tmcl ria   # only these methods
    python tests/oracle.py --renew    # write it anew, in a commit that says why

For a fixed seed and the preset `smoke` it trains each method and keeps the losses of each fit, the
assignments, the prediction errors, the returns of all test episodes, and twenty planned actions,
with frozen heads and with heads that learn. Planners and the robots' shapes are covered by T-MCL.
"""

import csv
import json
import math
import os
import sys
import tempfile
from pathlib import Path

os.environ.setdefault("XLA_FLAGS", "--xla_backend_optimization_level=0")  # compiles twice as fast

import numpy as np

import headway

KEPT = Path(__file__).with_suffix(".json")
TOLERANCE = 1e-5
FITTING = ("loss", "forward_loss", "updates", "skipped_updates", "transitions")
LEARNING = {"planner.adaptation": "last-layer", "planner.change_threshold": 20.0}
WITH_HEADS = ("tmcl", "mcl", "pets", "mh-pets", "vanilla", "stacked", "cadm", "pets-cadm", "ria")
PLANNERS = {
    "icem": {"planner.optimizer.name": "icem", "planner.optimizer.noise_beta": 0.25},
    "random-shooting": {"planner.optimizer.name": "random-shooting"},
    "bfloat16": {"planner.precision": "bfloat16"},
}
RUNS = {
    **{name: ("pendulum", name, {}) for name in (*WITH_HEADS, "grbal", "rebal", "random")},
    "tmcl-bayes": ("pendulum", "tmcl-bayes", {}),
    "pets-bayes": ("pendulum", "pets-bayes", {}),
    "oracle-params": ("pendulum", "oracle-params", {}),
    "true-dynamics": ("pendulum", "true-dynamics", {}),
    "half-cheetah": ("half-cheetah", "tmcl", {}),
    "bfloat16-fit": ("pendulum", "tmcl", {"fitting.precision": "bfloat16"}),
    "released-choices": (
        "pendulum",
        "tmcl",
        {
            "fitting.bootstrap": True,
            "fitting.drop_first_anchor": True,
            "fitting.context_weight_decay": False,
            "planner.selection_error": "sampled",
            "planner.selection_skips_newest": True,
            "planner.reward": "released",
            "planner.optimizer.narrow_at_bounds": True,
        },
    ),
}


def actions(run, settings):
    """Twenty planned actions along observations that depend on no simulator."""
    controller = headway.load(run.path, seed=1, settings=settings)
    controller.reset()
    rng = np.random.default_rng(0)
    angle, speed = rng.uniform(-3, 3, 20), rng.uniform(-1, 1, 20)
    walk = np.stack([np.cos(angle), np.sin(angle), speed], 1).astype(np.float32)
    return [float(x) for obs in walk for x in controller.act(obs)]


def measured(name, folder):
    env, method, settings = RUNS[name]
    run = headway.train(
        env, method=method, preset="smoke", seed=0, run_dir=Path(folder) / name, settings=settings
    )
    found = {}
    for metrics in run.metrics:
        i, fitting = metrics["iteration"], metrics.get("fitting", {})
        found[f"fitting {i}"] = [float(fitting[key]) for key in FITTING if key in fitting]
    columns = {"evaluation": "return", "assignments": "share", "prediction_error": "error"}
    for table, column in columns.items():
        path = run.path / f"{table}.csv"
        if path.exists():
            with path.open() as file:
                found[table] = [float(row[column]) for row in csv.DictReader(file)]
    if env == "pendulum" and method not in ("random", "true-dynamics", "oracle-params"):
        found["actions"] = actions(run, {})
        if name in WITH_HEADS:
            found["actions learning"] = actions(run, LEARNING)
    if name == "tmcl":
        for planner, changed in PLANNERS.items():
            found[f"actions {planner}"] = actions(run, changed)
    if name in ("tmcl", "pets-cadm"):
        tested = headway.evaluate(run.path, settings=LEARNING)
        found["returns learning"] = [row.episode_return for row in tested]
    return found


def differences(found, kept):
    for key in sorted(found.keys() | kept.keys()):
        mine, theirs = found.get(key, []), kept.get(key, [])
        if len(mine) != len(theirs):
            yield f"{key}: {len(mine)} numbers, kept {len(theirs)}"
            continue
        gaps = [
            abs(a - b) / max(1.0, abs(b))
            for a, b in zip(mine, theirs, strict=True)
            if not (math.isnan(a) and math.isnan(b))
        ]
        worst = max(gaps, default=0.0)
        if not worst <= TOLERANCE:
            yield f"{key}: differs by {worst:.3g}"


def main():
    names = [name for name in sys.argv[1:] if not name.startswith("-")] or list(RUNS)
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {}
    wrong = 0
    with tempfile.TemporaryDirectory() as folder:
        for name in names:
            found = measured(name, folder)
            if "--renew" in sys.argv:
                kept[name] = found
                KEPT.write_text(json.dumps(kept, indent=0) + "\n")
                continue
            said = list(differences(found, kept[name]))
            wrong += len(said)
            print(f"{name}: {'; '.join(said) or 'equal'}", flush=True)
    sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
