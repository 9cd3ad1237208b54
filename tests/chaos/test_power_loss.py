"""A run survives the loss of everything that was not synced yet."""

import killing
import numpy as np
import pytest
from killing import ALWAYS, NEVER, Killed, KillingProgress, Trigger
from power_loss import ForgetfulOS

from headway.experiment import training
from headway.storage import files, progress_store


def train_on_a_forgetful_disk(path, left, place, every, rng, monkeypatch):
    """Train until the power goes, and put what the disk kept at `left`; or until the end."""
    trigger = Trigger(place)
    disk = ForgetfulOS(trigger, path)
    with monkeypatch.context() as patch:
        patch.setattr(files, "os", disk)
        patch.setattr(progress_store, "EVERY", every)
        try:
            training.train_run(killing.tiny_config(), path, KillingProgress(trigger))
        except Killed:
            disk.after_power_loss(left, rng)
            return True
    return False


def check_losses(wanted, seed, reference, tmp_path, monkeypatch):
    rng = np.random.default_rng(seed)
    losses = runs = 0
    while losses < wanted:
        runs += 1
        path = tmp_path / f"start-{runs}"
        path.mkdir()
        every = (ALWAYS, NEVER)[rng.integers(2)]
        place = int(rng.integers(1, 600 if every == ALWAYS else 300))
        left = tmp_path / f"left-{runs}"
        if not train_on_a_forgetful_disk(path, left, place, every, rng, monkeypatch):
            continue
        losses += 1
        training.train_run(killing.tiny_config(), left)
        assert killing.result(left) == killing.result(reference), (seed, runs)


def test_five_losses_of_power_change_nothing(reference, tmp_path, monkeypatch):
    check_losses(5, 0, reference, tmp_path, monkeypatch)


@pytest.mark.slow
def test_a_hundred_losses_of_power_change_nothing(reference, tmp_path, monkeypatch):
    check_losses(100, 1, reference, tmp_path, monkeypatch)


def test_without_syncing_something_would_be_lost(tmp_path):
    path = tmp_path / "run"
    path.mkdir()
    disk = ForgetfulOS(Trigger(), path)
    (path / "note.txt").write_bytes(b"written, never synced" * 100)
    found = set()
    for seed in range(20):
        left = tmp_path / str(seed)
        disk.after_power_loss(left, np.random.default_rng(seed))
        found.add((left / "note.txt").read_bytes() if (left / "note.txt").exists() else None)
    assert None in found
    assert len(found) > 2
