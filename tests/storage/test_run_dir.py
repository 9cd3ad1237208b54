"""The run directory: checksums, schemas, one process at a time, going back."""

import ast
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import headway
from headway.errors import LimitError, RunError
from headway.experiment import training
from headway.report.figures import save_run_figures
from headway.storage import files
from headway.storage.iterations import Iterations
from headway.storage.manifest import Manifest
from headway.storage.run_dir import RunDir

DATA = Path(__file__).parent.parent / "data"


@pytest.fixture(params=[1, 2])
def sample(request, tmp_path) -> Path:
    """A tiny run with two of three iterations, of either schema."""
    path = tmp_path / "run"
    shutil.copytree(DATA / f"run-schema-{request.param}", path)
    return path


@pytest.fixture
def root(tmp_path) -> Path:
    path = tmp_path / "run"
    shutil.copytree(DATA / "run-schema-2", path)
    return path


def test_a_run_of_every_schema_is_read(sample):
    run = RunDir(sample)
    run.check()
    assert [row["iteration"] for row in run.metrics()] == [0, 1]
    assert {row.group for row in run.evaluation()} == {"low", "high"}
    assert len(run.load_data()) == 4
    assert save_run_figures(sample)
    action = headway.load(sample).act(np.array([1.0, 0.0, 0.0]))
    assert action.shape == (1,)


def test_a_run_is_read_while_an_iteration_is_finished(root, tmp_path, monkeypatch):
    newer = root / "manifests" / "iteration-001.json"
    hidden = newer.rename(tmp_path / "newer.json")
    newest = Iterations.newest

    def then_finished(self):
        found = newest(self)
        if hidden.exists():
            hidden.rename(newer)
        return found

    monkeypatch.setattr(Iterations, "newest", then_finished)
    assert [row["iteration"] for row in RunDir(root).metrics()] == [0]
    assert newer.exists()
    assert len(RunDir(root).metrics()) == 2


def test_a_run_of_every_schema_goes_on(sample):
    before = RunDir(sample).metrics()
    run = training.train_run(RunDir(sample).config(), sample)
    run.check()
    assert run.metrics()[:2] == before
    assert len(run.metrics()) == 3
    assert json.loads((sample / "config.json").read_text())["schema"] == 2
    manifest = Manifest.read(sample / "manifests" / "iteration-002.json")
    assert {"config.json", "metrics.jsonl", "data/iteration-000.safetensors"} < set(manifest.files)


def test_rows_of_an_unfinished_iteration_of_schema_1_are_left_behind(tmp_path):
    path = tmp_path / "run"
    shutil.copytree(DATA / "run-schema-1", path)
    with (path / "evaluation.csv").open("a") as table:
        table.write("tmcl,pendulum,0,2,low,length=0.25 mass=1,0,-1.5,12\n")
    assert {row.iteration for row in RunDir(path).evaluation()} == {0, 1}
    RunDir(path).create_or_resume(RunDir(path).config())
    assert ",2,low" not in (path / "evaluation.csv").read_text()
    RunDir(path).check()


@pytest.mark.parametrize(("schema", "says"), [(3, "update headway"), (0, "train the run again")])
def test_another_schema_is_refused_with_the_reason(schema, says, root):
    values = json.loads((root / "config.json").read_text())
    (root / "config.json").write_text(json.dumps({**values, "schema": schema}))
    with pytest.raises(RunError, match=f"schema {schema}, allowed: 1 or 2; .*{says}"):
        RunDir(root).config()


def flip(path: Path) -> None:
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 4
    path.write_bytes(content)


@pytest.mark.parametrize(
    "name",
    [
        "checkpoints/iteration-001.safetensors",
        "manifests/iteration-001.json",
        "data/iteration-001.safetensors",
    ],
)
def test_a_damaged_iteration_is_named_and_gone_back_from(name, root, tmp_path):
    config = RunDir(root).config()
    undamaged = tmp_path / "undamaged"
    shutil.copytree(root, undamaged)
    flip(root / name)
    with pytest.raises(RunError, match=f"{Path(name).name} is damaged.*last good iteration is 0"):
        training.train_run(config, root)
    run = training.train_run(config, root, resume_from_last_good=True)
    run.check()
    assert len(run.metrics()) == 3
    # It ends as a run whose last good iteration was the newest one from the start.
    (undamaged / "manifests" / "iteration-001.json").unlink()
    training.train_run(config, undamaged)
    for folder in ("checkpoints", "data"):
        for file in (undamaged / folder).iterdir():
            assert (root / folder / file.name).read_bytes() == file.read_bytes(), file


def test_a_damaged_checkpoint_is_not_loaded_either(root):
    flip(root / "checkpoints" / "iteration-001.safetensors")
    with pytest.raises(RunError, match=r"damaged.*--resume-from-last-good"):
        headway.load(root)


def test_without_an_intact_iteration_there_is_no_way_back(root):
    flip(root / "data" / "iteration-000.safetensors")
    with pytest.raises(RunError, match="No earlier iteration is intact"):
        RunDir(root).check()
    with pytest.raises(RunError, match="no intact iteration"):
        training.train_run(RunDir(root).config(), root, resume_from_last_good=True)


def test_an_intact_run_is_not_gone_back_from(root):
    before = (root / "manifests" / "iteration-001.json").read_bytes()
    assert RunDir(root).go_back() == 1
    assert (root / "manifests" / "iteration-001.json").read_bytes() == before


def test_lost_manifests_do_not_begin_a_run_anew(root):
    for manifest in (root / "manifests").iterdir():
        manifest.unlink()
    with pytest.raises(RunError, match=r"manifests holds 0 iterations, but iteration-001.* exists"):
        training.train_run(RunDir(root).config(), root)
    assert (root / "checkpoints" / "iteration-001.safetensors").exists()


HOLD = """
import sys
from pathlib import Path
from headway.storage.run_lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_a_second_process_is_refused_until_the_first_is_gone(root):
    command = [sys.executable, "-c", HOLD, str(root)]
    first = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert first.stdout is not None
        assert first.stdout.readline() == "held\n"
        with (
            pytest.raises(RunError, match="is being trained by another process"),
            RunDir(root).locked(),
        ):
            pass
    finally:
        first.kill()
        first.communicate()
    with RunDir(root).locked():
        pass


def test_a_full_disk_is_noticed_before_anything_is_written(root, monkeypatch):
    before = sorted(root.rglob("*"))
    usage = shutil.disk_usage(root)
    monkeypatch.setattr(files.shutil, "disk_usage", lambda _: usage._replace(free=10**6))
    with pytest.raises(LimitError, match=r"too full to write .*evaluation\.csv.*1,000,000 free"):
        RunDir(root).append_evaluation([])
    assert sorted(root.rglob("*")) == before


PICKLES = {"pickle", "cloudpickle", "dill", "joblib", "marshal", "shelve", "yaml", "torch"}
EVALUATING = {"eval", "exec", "compile", "__import__"}


@pytest.mark.parametrize("name", ["fifo", "folder", ".", "link"])
def test_only_regular_files_are_replaced(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    os.mkfifo("fifo")
    Path("folder").mkdir()
    Path("link").symlink_to("fifo")
    before = sorted(tmp_path.iterdir())
    with pytest.raises(RunError, match=r"is no regular file, allowed: .*; choose another name\.$"):
        files.write_bytes(Path(name), b"content")
    assert sorted(tmp_path.iterdir()) == before
    assert Path("fifo").is_fifo()
    files.write_bytes(Path("file"), b"content")
    files.write_bytes(Path("file"), b"other")
    assert Path("file").read_bytes() == b"other"


def test_nothing_in_the_package_can_turn_a_file_into_code():
    for path in Path(headway.__file__).parent.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                assert not {name.name.partition(".")[0] for name in node.names} & PICKLES, path
            if isinstance(node, ast.ImportFrom):
                assert (node.module or "").partition(".")[0] not in PICKLES, path
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id not in EVALUATING, path
            if isinstance(node, ast.keyword):
                assert node.arg not in ("allow_pickle", "shell"), path
