"""The benchmarks at their smallest size, and the commands that make results anew."""

import json
import subprocess
import sys
from pathlib import Path

import jax
import pytest
from reporting import NOT_MEASURED, Report, Target
from workloads import make_agent, make_fit

from headway.config import CEMConfig, FittingConfig, MultiHeadedConfig, PlannerConfig
from headway.models.fitting import fit_epoch

ROOT = Path(__file__).parents[1]
SMALL = MultiHeadedConfig(num_members=2, hidden_sizes=(8, 8), context_hidden_sizes=(8,))
PLAN = Target("plan", "cpu", "a plan", 0.8, "ratio", "")
RATE = Target("updates", "cpu", "updates", 100.0, "value", "/s", "at least")
GPU_PLAN = Target("plan", "gpu", "a plan", 4.0, "ratio", "")


def test_report_sets_targets_beside_what_was_measured(tmp_path, monkeypatch):
    monkeypatch.setattr("reporting.LATEST", tmp_path / "latest")
    report = Report([PLAN, RATE, GPU_PLAN])
    report.add("plan", 2.0, "s", ratio=0.75, ratio_to="products", key="plan")
    report.add("updates", 99.0, "/s", key="updates")
    table = report.write("bench")
    assert (tmp_path / "latest/bench.md").read_text() == table
    result = json.loads((tmp_path / "latest/bench.json").read_text())
    assert [row.get("met") for row in result["measurements"]] == [True, False, None]
    assert NOT_MEASURED in table.strip().splitlines()[-1]


def test_what_is_timed_runs_at_a_small_size():
    cem = CEMConfig(num_elites=2)
    planner = PlannerConfig(
        horizon=2, num_candidates=8, optimizer=cem, num_iterations=2, num_particles=2
    )
    agent, state, obs = make_agent(1, SMALL, planner)
    _, decision = agent.act(state, obs)
    assert decision.action.shape == (1, 6)
    fit, setup, data = make_fit(1, 1, SMALL, FittingConfig(batch_size=64))
    _, stats = fit_epoch(fit, setup, data, independent=False, key=jax.random.key(0))
    assert int(stats.updates) > 0


@pytest.mark.parametrize(
    ("words", "line"),
    [
        ("scores results/pendulum-quick", "| tmcl | 0.99 0.96 0.99 | 0.98 | 0.65 0.65 0.53 |"),
        (
            "shares results/hopper-methods --references results/ceilings/hopper-200",
            "| tmcl | 1.27 1.13 1.15 | 1.19 |",
        ),
        ("arms results/adaptation/pendulum-quick", "| tmcl | none | 0.99 0.96 0.99 (mean 0.98) |"),
        ("planners results/planners/six.csv", "| paper | -127 (100%) | -643 (100%) |"),
    ],
)
def test_tables_of_results_are_made_from_their_files(words, line, tmp_path):
    figure = [] if words.startswith(("scores", "shares")) else [str(tmp_path / "figure.png")]
    command = [sys.executable, "results/figures.py", *words.split(), *figure]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert line in done.stdout
    assert len(list(tmp_path.iterdir())) == len(figure)
