"""Missing runs are made once each, in a directory that is theirs, whatever happens to some."""

import sys
import threading
from types import SimpleNamespace

import pytest
from fakes import comparison, random_job, write_level

from headway.config import override
from headway.errors import ConfigError
from headway.lab.paper import sweep_experiment
from headway.lab.sweep import Job, State, Workers, fingerprint, run_jobs
from headway.training.methods import make_config
from headway.training.run import RunDir
from headway.training.train import train_run

HERE = Workers(one_by_one=True)


def test_a_directory_stands_for_all_settings_but_the_seed(tmp_path):
    plain = make_config("pendulum", preset="quick")
    same = make_config("pendulum", preset="quick", seed=5, settings={"planner.horizon": 20})
    assert fingerprint(plain) == fingerprint(same)
    assert Job.of(plain, tmp_path).path.parent == Job.of(same, tmp_path).path.parent
    others = [
        {"planner.horizon": 21},
        {"model.hidden_sizes": [128, 128, 128]},
        {"sim_params": {"train": {"length": [0.5], "mass": [1.0]}, "unseen": {}}},
    ]
    names = {fingerprint(make_config("pendulum", preset="quick", settings=s)) for s in others}
    assert len({fingerprint(plain), *names}) == 4


def test_what_a_run_only_tolerates_does_not_separate_runs(tmp_path):
    job = random_job(tmp_path)
    same = Job.of(override(job.config, {"evaluation.max_bad_episodes": 1}), tmp_path)
    assert same.path == job.path
    train_run(job.config, job.path)
    assert same.state.name == "done"


def test_another_run_in_the_directory_is_refused(tmp_path, monkeypatch):
    job = random_job(tmp_path, **{"planner.horizon": 3})
    write_level(job.path, random_job(tmp_path, **{"planner.horizon": 2}).config)
    assert job.state.name == "failed"
    assert "other settings (planner.horizon: 2 -> 3)" in job.state.note
    write_level(tmp_path / "again", job.config)
    assert Job(job.config, tmp_path / "again").state == State("done", 1)
    monkeypatch.setattr(RunDir, "environment_changes", lambda run: ["task.goal: 0 -> 1"])
    assert "task.goal" in Job(job.config, tmp_path / "again").state.note


def test_settings_of_an_arm_win_over_those_of_the_comparison(tmp_path):
    chosen = {"model.num_heads": 4, "planner.horizon": 7}
    configs = [job.config for job in comparison(tmp_path, "fig14", **chosen).jobs]
    assert [config.model.num_heads for config in configs] == [1, 2, 3, 5, 8]
    assert {config.planner.horizon for config in configs} == {7}


def test_jobs_of_the_first_seed_come_first(tmp_path):
    jobs = comparison(tmp_path, envs=("pendulum", "hopper"), seeds=(4, 2)).jobs
    assert [job.config.seed for job in jobs] == [4, 4, 4, 4, 2, 2, 2, 2]


def test_two_arms_with_the_same_settings_share_one_job(tmp_path):
    same = sweep_experiment("mine", ["tmcl"], {"fitting.weight_decay": [1, 1.0]})
    made = comparison(tmp_path, same)
    assert (len(made.cells), len(made.jobs)) == (2, 1)


@pytest.mark.parametrize(
    ("envs", "seeds"),
    [(("hopper",), (1, 1)), ((), (1,)), (("pendulum", "headway/Pendulum-v0"), (1,))],
)
def test_what_is_asked_twice_or_not_at_all_is_refused(envs, seeds, tmp_path):
    with pytest.raises(ConfigError, match="allowed: one or more, each once"):
        comparison(tmp_path, envs=envs, seeds=seeds)


def test_missing_runs_are_made_once_and_a_failing_one_stops_no_other(tmp_path, capsys):
    jobs = [random_job(tmp_path, seed) for seed in (2, 0, 1)]
    jobs[1].path.mkdir(parents=True)
    (jobs[1].path / "config.json").mkdir()  # nothing that a check before training can see
    write_level(jobs[2].path, jobs[2].config)
    damaged = random_job(tmp_path, 3)
    damaged.path.mkdir(parents=True)
    (damaged.path / "config.json").write_text("{")
    failures = run_jobs([*jobs, damaged], HERE, quiet=False)
    assert failures.keys() == {jobs[1].path, damaged.path}
    assert jobs[0].state.name == "done"
    err = capsys.readouterr().err
    assert err.startswith("[3/4] 1 runs are missing\n")
    assert f"[4/4] {jobs[0].name}: done" in err
    assert run_jobs(jobs[::2], HERE) == {}


def test_a_run_that_another_process_holds_is_waited_for(tmp_path, monkeypatch):
    job, held, busy = random_job(tmp_path), threading.Event(), threading.Event()
    job.path.mkdir(parents=True)

    def write(text):
        if ": busy" in text:
            busy.set()

    def hold():
        with RunDir(job.path).locked():
            held.set()
            busy.wait(120)

    threading.Thread(target=hold, daemon=True).start()
    held.wait(10)
    monkeypatch.setattr(sys, "stderr", SimpleNamespace(write=write, flush=lambda: None))
    assert run_jobs([job], HERE, quiet=False) == {}
    assert busy.is_set()
    assert job.state.name == "done"


def test_an_environment_of_ones_own_is_found_by_the_workers(tmp_path, monkeypatch):
    module = (
        "from headway.task import env_spec\n\ncart = env_spec('pendulum')\nprint('a' * 70_000)\n"
    )
    (tmp_path / "own_carts.py").write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    (job,) = comparison(tmp_path, sweep_experiment("own", ["random"], {}), ("own_carts:cart",)).jobs
    assert run_jobs([job], HERE) == {}
    assert job.state.name == "done"


def test_a_run_that_loses_all_its_workers_fails_and_says_so(tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text("import os\nos._exit(9)\n")
    monkeypatch.syspath_prepend(tmp_path)  # every worker dies while Python starts
    job = random_job(tmp_path)
    (reason,) = run_jobs([job], HERE).values()
    assert reason == "its process ended with 9; 5 times without finishing an iteration"


IMPOSSIBLE = [{"cpus_per_run": 0}, {"gpus_per_run": -1}, {"gpus_per_run": 1.5}]
IMPOSSIBLE += [{"one_by_one": True} | more for more in ({"address": "auto"}, {"cpus_per_run": 2})]


@pytest.mark.parametrize("wrong", IMPOSSIBLE)
def test_impossible_workers_are_refused(wrong):
    with pytest.raises(ConfigError, match=r"allowed|leave one out"):
        Workers(**wrong)


def test_without_ray_runs_go_one_by_one_and_a_cluster_is_refused(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    job = random_job(tmp_path)
    with pytest.raises(ConfigError, match=r"install headway\[ray\]"):
        run_jobs([job], Workers(address="auto"))
    assert run_jobs([job], Workers()) == {}
    assert job.state.name == "done"
