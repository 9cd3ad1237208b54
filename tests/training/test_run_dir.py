"""The run directory: checksums, going back, one process at a time, nothing half-written."""

import errno
import fcntl
import itertools
import json
import os
import re
import subprocess
import sys
from pathlib import Path

import jax
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

import headway
import runs
from headway.errors import BusyError, RunError
from headway.training.files import load_arrays, write_bytes
from headway.training.run import RunDir
from headway.training.train import train_run
from headway.training.trainers import make_trainer

TABLES = ["metrics.jsonl", "evaluation.csv", "assignments.csv", "prediction_error.csv"]
NAMES = (
    "data/iteration-000",
    "data/iteration-001",
    "tests/iteration-001",
    "checkpoints/iteration-001",
)
BINARY = [f"{name}.safetensors" for name in NAMES]
FILES = ["config.json", *TABLES, *BINARY]
NEWEST = "checksums/iteration-001.json"


def refused(read, *args) -> str:
    """The one line with which reading fails."""
    with pytest.raises(RunError) as caught:
        read(*args)
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 1000
    return text


def flip(path):
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


DAMAGE = {
    "flipped": flip,
    "cut": lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "empty": lambda path: path.write_bytes(b""),
    "gone": Path.unlink,
}


CASES = [*itertools.product(FILES, DAMAGE), (NEWEST, "flipped"), (NEWEST, "empty")]


@pytest.mark.parametrize(("name", "how"), CASES)
def test_damage_to_any_file_is_named_with_the_way_back(name, how, root):
    DAMAGE[how](root / name)
    text = refused(RunDir(root).check)
    assert name == NEWEST or Path(name).name in text  # a sum of something that seems to differ
    if "001" in name:
        assert "last good iteration is 0" in text
        assert "--resume-from-last-good" in text


@pytest.mark.parametrize("name", [*BINARY, NEWEST])
def test_a_run_goes_on_from_its_last_good_iteration(name, root, reference):
    flip(root / name)
    with pytest.raises(RunError, match=r"last good iteration is 0|No earlier iteration"):
        train_run(runs.tiny_config(), root)
    if "data/iteration-000" in name:
        with pytest.raises(RunError, match="no intact iteration"):
            train_run(runs.tiny_config(), root, resume_from_last_good=True)
        return
    heard = runs.Listening()
    train_run(runs.tiny_config(), root, heard, resume_from_last_good=True)
    assert heard.said == ["goes on after iteration 0, which is intact"]
    assert runs.result(root) == runs.result(reference)


def test_lost_checksums_do_not_begin_a_run_anew(root):
    for path in (root / "checksums").iterdir():
        path.unlink()
    with pytest.raises(RunError, match=r"holds 0 iterations, but the checkpoint of iteration 1"):
        train_run(runs.tiny_config(), root)
    assert (root / "checkpoints/iteration-001.safetensors").exists()


def test_a_damaged_checkpoint_is_not_loaded(root):
    flip(root / "checkpoints/iteration-001.safetensors")
    with pytest.raises(RunError, match=r"damaged.*--resume-from-last-good"):
        headway.load(root)


def test_damaged_data_are_not_loaded(root):
    flip(root / "data/iteration-000.safetensors")
    with pytest.raises(RunError, match=r"iteration-000.*damaged"):
        RunDir(root).load_data()


def test_what_was_left_unfinished_in_a_run_is_tidied_away(root, reference):
    (root / ".pendulum-v0.writing" / "data").mkdir(parents=True)
    (root / ".config.json.77.writing").write_text("{")
    train_run(runs.tiny_config(), root)
    assert not list(root.rglob(".*.writing"))
    assert runs.result(root) == runs.result(reference)


def test_a_checkpoint_of_another_model_is_refused(root):
    config = runs.tiny_config(**{"model.hidden_sizes": (9, 9)})
    with pytest.raises(RunError, match="belongs to another model"):
        make_trainer(config).load(RunDir(root))


def test_what_is_read_is_what_was_written(root):
    run = RunDir(root)
    assert [row["iteration"] for row in run.metrics()] == [0, 1]
    tests = run.tests()
    rows = [row for row in run.evaluation() if row.iteration == 1]
    found = [(group, t.returns, len(t)) for group, ts in tests.items() for t in ts]
    assert found == [(row.group, row.episode_return, row.length) for row in rows]
    assert [dict(t.sim_params) for t in tests["low"]] == [
        dict(row.sim_params) for row in rows if row.group == "low"
    ]
    assert len(run.load_data()) == 4
    assert sum(len(t) for t in run.load_data()) == run.metrics()[-1]["timesteps"]
    errors = pd.read_csv(root / "prediction_error.csv")
    assert {row["iteration"] for row in run.assignments()} | {*errors.iteration} == {0, 1}


def test_rows_of_an_unfinished_iteration_do_not_count(root, reference):
    for name in TABLES:
        with (root / name).open("a") as table:
            table.write("half a line")
    assert len(RunDir(root).metrics()) == 2
    train_run(runs.tiny_config(), root)
    assert runs.result(root) == runs.result(reference)


def test_settings_versions_and_commit_are_kept(root):
    found = json.loads((root / "config.json").read_bytes())
    kept = RunDir(root).config()
    assert kept == runs.tiny_config(spaces=kept.spaces)
    assert found["versions"]["jax"] == jax.__version__
    checkout = Path(headway.__file__).parents[2]
    if (checkout / ".git").exists():
        words = ["git", "-C", str(checkout), "rev-parse", "HEAD"]
        assert found["commit"] == subprocess.check_output(words, text=True).strip()


def test_another_schema_is_refused_with_the_reason(root):
    values = json.loads((root / "config.json").read_text())
    (root / "config.json").write_text(json.dumps({**values, "schema": 2}))
    assert "schema 2, allowed: 4; train the run again" in refused(RunDir(root).config)


def test_other_settings_are_refused_with_the_difference(root):
    with pytest.raises(RunError, match=r"planner\.horizon: 3 -> 5"):
        train_run(runs.tiny_config(**{"planner.horizon": 5}), root)


def test_settings_that_were_edited_are_refused_though_the_run_becomes_longer(root):
    path = root / "config.json"
    path.write_text(path.read_text().replace('"horizon": 3', '"horizon": 5'))
    longer = {"planner.horizon": 5, "collection.num_iterations": 9}
    assert "config.json is damaged" in refused(train_run, runs.tiny_config(**longer), root)


def test_what_is_no_run_is_left_alone(tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(RunError, match="holds no run"):
        train_run(runs.tiny_config(), tmp_path)
    with pytest.raises(RunError, match="is a file, allowed: a directory"):
        train_run(runs.tiny_config(), tmp_path / "thesis.txt")
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


HOLD = """
import sys
from headway.training.run import RunDir
with RunDir(sys.argv[1]).locked():
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_process_is_refused_until_the_first_is_killed(root):
    words = [sys.executable, "-c", HOLD, str(root)]
    first = subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert first.stdout.readline() == "held\n"
        with pytest.raises(BusyError, match="is being trained by another"), RunDir(root).locked():
            pass
    finally:
        first.kill()
        first.communicate()
    with RunDir(root).locked():
        pass


@pytest.mark.parametrize(
    "error", [OSError(errno.ENOLCK, "No locks here"), NotImplementedError("No locks here")]
)
def test_where_nothing_can_be_locked_a_run_is_refused_in_one_line(error, root, monkeypatch):
    def no_lock(*_):
        raise error

    monkeypatch.setattr(fcntl, "flock", no_lock)
    with pytest.raises(RunError, match="cannot be written: No locks"), RunDir(root).locked():
        pass


def test_folders_that_cannot_be_synced_are_written_to(tmp_path, monkeypatch):
    plain = os.fsync

    def files_only(handle):
        if os.path.isdir(f"/proc/self/fd/{handle}"):  # noqa: PTH112
            raise OSError(errno.EINVAL, "Invalid argument")
        plain(handle)

    def no_folders(path, flags):
        raise OSError(errno.EISDIR, "Is a directory")

    for name, instead in (("fsync", files_only), ("open", no_folders)):
        monkeypatch.setattr(os, name, instead)
        write_bytes(tmp_path / "new" / name, b"content")
        assert (tmp_path / "new" / name).read_bytes() == b"content"


@pytest.mark.parametrize("name", ["fifo", "folder", ".", "link"])
def test_only_regular_files_are_replaced(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("fifo")
    Path("folder").mkdir()
    Path("link").symlink_to("fifo")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(RunError, match=r"is no regular file, allowed: .*; choose another name\.$"):
        write_bytes(Path(name), b"content")
    assert sorted(tmp_path.iterdir()) == before


def test_writing_does_not_follow_a_link_that_lies_in_wait(tmp_path):
    victim = tmp_path / "victim.txt"
    victim.write_text("mine")
    (tmp_path / f".table.csv.{os.getpid()}.writing").symlink_to(victim)
    write_bytes(tmp_path / "table.csv", b"rows")
    assert victim.read_text() == "mine"


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return tmp_path_factory.mktemp("any") / "file"


@given(content=st.binary(max_size=200))
def test_any_bytes_are_refused_in_one_line(file, content):
    file.write_bytes(content)
    refused(load_arrays, file)


CODE_FROM_FILES = re.compile(
    r"^ *(import|from) (pickle|cloudpickle|dill|joblib|marshal|shelve|yaml|torch)\b"
    r"|(?<![\w.])(eval|exec|compile|__import__)\(|\b(allow_pickle|shell) ?=",
    re.MULTILINE,
)


def test_nothing_in_the_package_can_turn_a_file_into_code():
    for path in Path(headway.__file__).parent.rglob("*.py"):
        assert not CODE_FROM_FILES.search(path.read_text()), path
