"""Data files opened memory-mapped: the same numbers, read-only, and damage is named."""

import dataclasses
import json

import numpy as np
import pytest
import safetensors.numpy

import toys
from headway.errors import RunError
from headway.storage import files, records
from headway.storage.mapped import map_arrays


def mapping_of(array):
    """The memory-mapped file that an array is a view of, or None."""
    while array is not None and not isinstance(array, np.memmap):
        array = array.base
    return array


@pytest.fixture
def path(tmp_path):
    """A file with arrays of both types, odd sizes and a remark."""
    rng = np.random.default_rng(0)
    arrays = {
        "0.obs": rng.normal(size=(4, 3)).astype(np.float32),
        "0.reward": rng.normal(size=3),
        "1.action": rng.normal(size=(5, 1)).astype(np.float32),
    }
    safetensors.numpy.save_file(arrays, tmp_path / "a.safetensors", metadata={"by": "a test"})
    return tmp_path / "a.safetensors"


def test_mapped_arrays_equal_the_loaded_ones_and_share_one_read_only_mapping(path):
    mapped, loaded = map_arrays(path), safetensors.numpy.load_file(path)
    assert set(mapped) == set(loaded)
    for name, array in mapped.items():
        assert array.dtype == loaded[name].dtype
        np.testing.assert_array_equal(array, loaded[name])
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0
    mappings = {id(mapping_of(array)) for array in mapped.values()}
    assert len(mappings) == 1
    assert id(None) not in mappings


def test_numbers_are_read_from_the_file_when_they_are_touched(path):
    obs = map_arrays(path)["0.obs"]
    changed = {**safetensors.numpy.load_file(path), "0.obs": np.full((4, 3), 7, np.float32)}
    content = safetensors.numpy.save(changed, metadata={"by": "a test"})
    with path.open("r+b") as file:
        file.write(content)
    np.testing.assert_array_equal(obs, 7.0)


def test_views_outlive_a_file_that_is_replaced(path):
    mapped, before = map_arrays(path), safetensors.numpy.load_file(path)
    files.write_bytes(path, b"something else")
    np.testing.assert_array_equal(mapped["0.obs"], before["0.obs"])


@pytest.mark.parametrize("keep", [0, 7, 10, 100, -1])
def test_a_damaged_file_is_named(keep, path):
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(RunError, match=r"a\.safetensors is damaged: "):
        map_arrays(path)


def test_a_file_of_other_types_is_refused(tmp_path):
    safetensors.numpy.save_file({"0.obs": np.zeros(3, np.int8)}, tmp_path / "b.safetensors")
    with pytest.raises(RunError, match=r"b\.safetensors is damaged: .* an unknown type"):
        map_arrays(tmp_path / "b.safetensors")


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(RunError, match=r"c\.safetensors is missing"):
        map_arrays(tmp_path / "c.safetensors")


def test_trajectories_come_back_as_they_were_but_stay_in_their_file(tmp_path):
    toy = [toys.random_trajectory(n, seed=n, gain=n) for n in (3, 1)]
    saved = [dataclasses.replace(t, reward=t.reward.astype(np.float64)) for t in toy]
    records.save_trajectories(tmp_path / "data", saved)
    loaded = records.load_trajectories(tmp_path / "data")
    assert json.loads((tmp_path / "data.json").read_text())[0]["sim_params"] == {"gain": 3.0}
    for old, new in zip(saved, loaded, strict=True):
        assert (new.sim_params, new.terminated) == (old.sim_params, old.terminated)
        for name in ("obs", "action", "reward"):
            np.testing.assert_array_equal(getattr(new, name), getattr(old, name))
            assert mapping_of(getattr(new, name)) is not None
