"""Too large a run is refused before it starts, and the estimate is about right."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from headway import api
from headway.errors import LimitError
from headway.experiment import limits, loading, training
from headway.experiment.methods import make_config
from headway.storage.run_dir import RunDir

GIB = 2**30


def need(**settings):
    preset = settings.pop("preset", "smoke")
    env = settings.pop("env", "pendulum")
    return loading.need_of(make_config(env, preset=preset, settings=settings))


def test_a_run_that_does_not_fit_is_refused_with_the_numbers(monkeypatch, tmp_path):
    monkeypatch.setattr(limits, "free_memory", lambda: 3 * GIB)
    monkeypatch.setattr(limits, "resident", lambda: 0)
    config = make_config("pendulum", preset="smoke", settings={"planner.num_candidates": 10**8})
    with pytest.raises(LimitError, match=r"about .* GiB .*planning .*3 GiB is free.*ignore-limits"):
        training.train_run(config, tmp_path / "run")
    assert not (tmp_path / "run").exists()
    with pytest.raises(LimitError):
        api.train(
            "pendulum",
            preset="smoke",
            run_dir=tmp_path / "run",
            settings={"planner.num_candidates": 10**8},
        )


def test_what_cannot_ignore_the_limits_is_not_advised_to(monkeypatch):
    run = Path(__file__).parents[1] / "data" / "run-schema-2"
    monkeypatch.setattr(limits, "free_memory", lambda: 3 * GIB)
    monkeypatch.setattr(limits, "resident", lambda: 0)
    with pytest.raises(LimitError, match=r"choose smaller sizes or fewer candidates") as raised:
        api.evaluate(run, settings={"planner.num_candidates": 10**8})
    assert "ignore" not in str(raised.value)


@pytest.fixture
def no_memory(monkeypatch):
    """Nothing is free, and nothing is held that could be given back."""
    monkeypatch.setattr(limits, "free_memory", lambda: 0)
    monkeypatch.setattr(limits, "resident", lambda: 0)


@pytest.mark.usefixtures("no_memory")
def test_a_run_that_does_not_fit_may_be_tried_all_the_same(monkeypatch, tmp_path):
    class BegunError(Exception):
        pass

    def begin(*_):
        raise BegunError

    monkeypatch.setattr(training.Trainer, "open", begin)
    config = make_config("pendulum", preset="smoke")
    with pytest.raises(LimitError):
        training.train_run(config, tmp_path / "run")
    with pytest.raises(BegunError):
        training.train_run(config, tmp_path / "run", ignore_limits=True)


@pytest.mark.usefixtures("no_memory")
def test_a_begun_run_goes_on_where_limits_are_ignored(monkeypatch, tmp_path):
    class LoadedError(Exception):
        pass

    def load(*_):
        raise LoadedError

    monkeypatch.setattr(RunDir, "finished_iterations", 1)
    monkeypatch.setattr(RunDir, "load_data", lambda run: [])
    monkeypatch.setattr(RunDir, "check", lambda run: None)
    monkeypatch.setattr(loading.arrays, "load_tree", load)
    config = make_config("pendulum", preset="smoke")
    with pytest.raises(LoadedError):
        training.train_run(config, tmp_path / "run", ignore_limits=True)


def test_a_model_that_does_not_fit_is_not_built(monkeypatch, tmp_path):
    settings = {"model.hidden_sizes": (10**9,) * 4, "model.num_members": 10**8}
    settings["planner.num_particles"] = 10**8
    config = make_config("pendulum", preset="smoke", settings=settings)
    monkeypatch.setattr(RunDir, "finished_iterations", 1)
    with pytest.raises(LimitError, match=r"over 10\^12"):
        loading.load_learned(RunDir(tmp_path), config)


def test_the_estimate_grows_with_what_takes_the_memory():
    base = need()
    assert need(**{"planner.num_candidates": 160}).planning > 9 * base.planning
    assert need(**{"collection.num_episodes": 20}).data == 10 * base.data
    assert need(**{"model.num_members": 4, "planner.num_particles": 4}).model == 2 * base.model
    assert need(**{"fitting.batch_size": 320}).fitting > base.fitting
    separate = need(**{"collection.env_processes": True})
    assert separate.total - base.total == separate.workers > 0 == base.workers
    assert separate.times(3).workers == 3 * separate.workers  # every run has its own
    assert separate.to_test.workers > 0 == separate.to_load.workers
    assert need(preset="paper", env="half-cheetah").total < 8 * GIB


def test_weights_are_counted(monkeypatch):
    for name, method, settings in [
        ("pendulum", "tmcl", {}),
        ("hopper", "tmcl", {"model.context_size": 0, "model.backward_net": False}),
        ("slim-humanoid", "tmcl", {"model.deterministic": True}),
        ("pendulum", "rebal", {}),
        ("pendulum", "grbal", {}),
    ]:
        config = make_config(name, method=method, settings=settings)
        task = loading.load_task(config)
        model = loading.eqx.filter_eval_shape(lambda c=config, t=task: loading.initial(c, t))
        leaves = training.jax.tree.leaves(model.fit.model)
        counted = sum(leaf.size for leaf in leaves)
        assert counted == pytest.approx(limits.num_parameters(config, task), rel=0.1)


@pytest.mark.parametrize(
    ("controllers", "names"),
    [
        ("", ("memory.max", "memory.current")),
        ("memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")),
    ],
)
def test_control_groups_count_too(controllers, names, monkeypatch, tmp_path):
    outer = tmp_path / controllers / "user"
    inner = outer / "job"
    inner.mkdir(parents=True)
    for folder, limit, used in ((outer, 5 * GIB, GIB), (inner, "max", 0)):
        (folder / names[0]).write_text(f"{limit}\n")
        (folder / names[1]).write_text(f"{used}\n")
    (outer / "memory.stat").write_text(f"anon 5\ninactive_file {GIB // 2}\n")
    (tmp_path / "cgroup").write_text(f"3:cpu:/other\n0:{controllers}:/user/job\n")
    (tmp_path / "meminfo").write_text(f"MemTotal: 9 kB\nMemAvailable: {8 * GIB // 1024} kB\n")
    monkeypatch.setattr(limits, "CGROUP", tmp_path / "cgroup")
    monkeypatch.setattr(limits, "CGROUP_ROOT", tmp_path)
    monkeypatch.setattr(limits, "MEMINFO", tmp_path / "meminfo")
    assert limits.free_memory() == 4 * GIB + GIB // 2
    (outer / names[0]).write_text(f"{50 * GIB}\n")
    assert limits.free_memory() == 8 * GIB


def test_where_nothing_is_known_nothing_is_refused(monkeypatch, tmp_path):
    monkeypatch.setattr(limits, "CGROUP", tmp_path / "none")
    monkeypatch.setattr(limits, "MEMINFO", tmp_path / "none")
    assert limits.free_memory() is None
    limits.check_memory(need()._replace(planning=10**18))


def test_an_accelerator_has_a_memory_of_its_own(monkeypatch):
    class Device:
        platform, device_kind = "gpu", "Toy 9"

        def memory_stats(self):
            return {"bytes_limit": 2 * GIB, "bytes_in_use": GIB}

    monkeypatch.setattr(limits.jax, "local_devices", lambda: [Device()])
    monkeypatch.setattr(limits, "free_memory", lambda: 10 * GIB)
    limits.check_memory(need()._replace(workers=2 * GIB))
    with pytest.raises(LimitError, match=r"1 GiB is free on Toy 9"):
        limits.check_memory(need()._replace(planning=2 * GIB))
    with pytest.raises(LimitError, match=r"on this machine"):
        limits.check_memory(need()._replace(process=20 * GIB))
    monkeypatch.setattr(Device, "memory_stats", lambda self: None)
    limits.check_memory(need()._replace(planning=20 * GIB))


MEASURE = """
import json, resource, sys, tempfile
from headway.experiment import loading, training
from headway.experiment.methods import make_config
env, settings = json.loads(sys.argv[1])
config = make_config(env, preset="smoke", settings=settings)
with tempfile.TemporaryDirectory() as folder:
    training.train_run(config, folder + "/run")
peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
print(json.dumps({"peak": peak, "need": loading.need_of(config)._asdict()}))
"""
PLANNING = {
    "planner.num_candidates": 20_000,
    "planner.num_particles": 10,
    "model.hidden_sizes": [64],
}
SIZES = {
    "smallest": ("pendulum", {}),
    "planning": ("pendulum", {**PLANNING, "collection.episode_length": 8}),
    "data": (
        "pendulum",
        {
            "collection.num_episodes": 100,
            "collection.episode_length": 2000,
            "fitting.epochs": 1,
            "fitting.batch_size": 4096,
            "fitting.future_length": 20,
            "planner.num_candidates": 8,
            "planner.num_iterations": 1,
            "evaluation.num_episodes": 1,
            "collection.num_iterations": 1,
        },
    ),
    "model": (
        "pendulum",
        {"model.hidden_sizes": [1500, 1500, 1500], "collection.episode_length": 8},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("size", SIZES)
def test_the_estimate_is_within_a_factor_of_two_of_the_peak(size):
    words = [sys.executable, "-c", MEASURE, json.dumps(SIZES[size])]
    done = subprocess.run(words, check=True, capture_output=True, text=True)
    found = json.loads(done.stdout)
    parts = found["need"]
    total = parts["process"] + parts["model"] + parts["data"]
    total += max(parts["fitting"], parts["planning"])
    print(f"{size}: estimated {total / GIB:.2f} GiB, measured {found['peak'] / GIB:.2f} GiB", parts)
    assert 0.5 < total / found["peak"] < 2.0


@pytest.mark.parametrize("work", ["train", "evaluate"])
def test_programs_are_forgotten_before_linux_refuses_more_of_them(work, monkeypatch, tmp_path):
    maps, allowed, cleared = tmp_path / "maps", tmp_path / "max", []
    monkeypatch.setattr(limits, "MAPS", maps)
    monkeypatch.setattr(limits, "MAX_MAPS", allowed)
    monkeypatch.setattr(limits.jax, "clear_caches", lambda: cleared.append(1))
    sample = Path(__file__).parents[1] / "data" / "run-schema-2"

    def begin():
        if work == "evaluate":
            api.evaluate(sample, settings={"planner.num_candidates": 10**8})
        settings = {"planner.num_candidates": 10**8}
        config = make_config("pendulum", preset="smoke", settings=settings)
        training.train_run(config, tmp_path / "run")

    for count, times in ((0, 0), (49, 0), (50, 1)):
        allowed.write_text("100\n")
        maps.write_text("7f00-7f01 r-xp\n" * count)
        with pytest.raises(LimitError):  # which is looked at afterwards
            begin()
        assert len(cleared) == times
    allowed.unlink()  # another system
    assert not limits.make_room_for_programs()
