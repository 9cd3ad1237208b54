"""A run that is killed anywhere, however often, ends like one that never was."""

import errno

import killing
import numpy as np
import pytest
from killing import ALWAYS, NEVER, Killed, Trigger

from headway.errors import LimitError
from headway.experiment import training
from headway.training.progress import Progress


@pytest.fixture(scope="module")
def num_places(tmp_path_factory):
    """At how many places a whole run can be killed, by how often it saves."""
    patch = pytest.MonkeyPatch()
    folder = tmp_path_factory.mktemp("whole")
    return {
        every: killing.train(killing.tiny_config(), folder / str(every), patch, every=every).places
        for every in (ALWAYS, NEVER)
    }


def kill_until_done(path, monkeypatch, rng, num_places, max_kills):
    """Kill a run again and again at random places, then let it end; returns the kills."""
    kills = 0
    while kills < max_kills:
        every = (ALWAYS, NEVER)[rng.integers(2)]
        place = int(rng.integers(1, num_places[every] + 1))
        try:
            killing.train(killing.tiny_config(), path, monkeypatch, kill_at=place, every=every)
            break
        except Killed:
            kills += 1
    killing.train(killing.tiny_config(), path, monkeypatch)
    return kills


def test_saving_all_the_time_changes_nothing(reference, tmp_path, monkeypatch):
    trigger = killing.train(killing.tiny_config(), tmp_path / "run", monkeypatch, every=ALWAYS)
    assert killing.result(tmp_path / "run") == killing.result(reference)
    assert trigger.places > 500


def check_kills(wanted, seed, reference, tmp_path, monkeypatch, num_places):
    rng = np.random.default_rng(seed)
    kills = runs = 0
    while kills < wanted:
        path = tmp_path / f"run-{runs}"
        kills += kill_until_done(path, monkeypatch, rng, num_places, max_kills=5)
        assert killing.result(path) == killing.result(reference), (seed, runs)
        runs += 1
    print(f"{kills} kills in {runs} runs")


def test_ten_kills_change_nothing(reference, tmp_path, monkeypatch, num_places):
    check_kills(10, 0, reference, tmp_path, monkeypatch, num_places)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 5))
def test_a_hundred_kills_change_nothing(seed, reference, tmp_path, monkeypatch, num_places):
    check_kills(100, seed, reference, tmp_path, monkeypatch, num_places)


@pytest.mark.parametrize("place", [1, 2, 40, 150, 400])
def test_a_disk_that_runs_full_stops_the_run_and_changes_nothing(
    place, reference, tmp_path, monkeypatch
):
    class FullDisk(Trigger):
        def pull(self):
            self.places += 1
            if self.places >= place:
                raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(killing, "Trigger", lambda _: FullDisk())
    monkeypatch.setattr(killing, "KillingProgress", lambda _: Progress())
    with pytest.raises(LimitError, match=r"too full to (write|delete)"):
        killing.train(killing.tiny_config(), tmp_path / "run", monkeypatch, every=ALWAYS)
    assert not list((tmp_path / "run").rglob("*.writing"))
    training.train_run(killing.tiny_config(), tmp_path / "run")
    assert killing.result(tmp_path / "run") == killing.result(reference)
