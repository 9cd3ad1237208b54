"""What a dry run says: arithmetic from settings, speed from finished runs."""

import fakes
import pytest

from headway.planning.flop import plan_flop
from headway.sweeps.cost import make_plan, run_flop
from headway.sweeps.jobs import Job
from headway.training.loading import load_task
from headway.training.methods import make_config


def test_an_estimate_counts_what_is_missing_at_the_speed_of_what_is_done(tmp_path):
    jobs = [fakes.tiny_job(tmp_path, seed) for seed in range(3)]
    plan = make_plan(jobs)
    assert [one.state for one in plan.jobs] == ["waiting"] * 3
    assert "just now" in plan.source
    fakes.write_run(jobs[0].config, jobs[0].path)
    plan = make_plan(jobs)
    assert [one.state for one in plan.jobs] == ["done", "waiting", "waiting"]
    # The fake run says that it took 4 seconds per iteration, and has 2.
    assert plan.seconds() == pytest.approx(16.0)
    assert plan.source == "1 finished runs"


def test_runs_that_learn_nothing_tell_no_speed(tmp_path):
    learns_nothing = [
        Job.of(make_config("pendulum", method=method, preset="smoke"), tmp_path)
        for method in ("random", "true-dynamics")
    ]
    fakes.write_run(learns_nothing[0].config, learns_nothing[0].path)
    jobs = [fakes.tiny_job(tmp_path), *learns_nothing]
    plan = make_plan(jobs)
    assert [one.state for one in plan.jobs] == ["waiting", "done", "waiting"]
    assert "just now" in plan.source
    assert 0 < plan.seconds() < 60
    assert "the time of 1 missing runs that plan on the true dynamics" in plan.note
    fakes.write_run(learns_nothing[1].config, learns_nothing[1].path)
    fakes.write_run(jobs[0].config, jobs[0].path)
    plan = make_plan([*jobs, fakes.tiny_job(tmp_path, 1)])
    assert plan.seconds() == pytest.approx(8.0)  # as long as the only run that learned
    assert (plan.source, plan.note) == ("1 finished runs", "")


def test_arithmetic_of_a_run_follows_its_settings(tmp_path):
    def flop(first_iteration=0, **changes):
        return run_flop(fakes.tiny_job(tmp_path, **changes).config, first_iteration)

    whole = flop()
    assert 0 < flop(1) < whole
    assert flop(2) == 0
    # Pendulum has two unseen groups of two episodes of six steps, tested twice, the training
    # physics once, and collects two planned episodes; the rest is fitting.
    steps = (2 * 2 + 1) * 2 * 6 + 2 * 6
    config = fakes.tiny_job(tmp_path).config
    fitting = whole - steps * plan_flop(config.model, config.planner, load_task(config))
    assert flop(**{"fitting.epochs": 2}) == pytest.approx(whole + fitting)
    always = flop(**{"evaluation.training_group": "always"})  # once more, after iteration 0
    assert always - whole == pytest.approx((whole - fitting) / steps * 2 * 6)
    seldom = {"evaluation.training_group": "always", "evaluation.every": 2}
    assert flop(**seldom) == flop(**{"evaluation.every": 2})
    assert flop(**{"planner.horizon": 6}) == pytest.approx(2 * whole - fitting)
