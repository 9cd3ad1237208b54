"""Damaged and hostile files are refused in one line, at once, with little memory."""

import json
import os
import resource
import shutil
import time
from pathlib import Path

import damage
import numpy as np
import pytest

from headway import settings
from headway.config import Config
from headway.errors import ConfigError, HeadwayError, RunError
from headway.experiment import loading, training
from headway.storage import arrays, records
from headway.storage.run_dir import RunDir
from headway.storage.tables import EVALUATION_COLUMNS

DATA = Path(__file__).parent.parent / "data"
SECONDS, BYTES = 5.0, 2**30
seconds: list[float] = []
TEXTS = ("metrics.jsonl", "evaluation.csv", "assignments.csv", "prediction_error.csv")


@pytest.fixture
def root(tmp_path) -> Path:
    shutil.copytree(DATA / "run-schema-2", tmp_path / "run")
    return tmp_path / "run"


@pytest.fixture(scope="module")
def template():
    config = RunDir(DATA / "run-schema-2").config()
    task = loading.load_task(config)
    return loading.eqx.filter_eval_shape(lambda: loading.initial(config, task))


@pytest.fixture(autouse=True, scope="module")
def memory():
    """No file may take much memory."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    yield
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    print(f"\n{len(seconds)} files, slowest {max(seconds):.2f} s, memory {grown / 2**20:.0f} MiB")
    assert grown < BYTES


def read_all(root: Path, template) -> None:
    """Everything that resuming, testing and drawing read."""
    run = RunDir(root)
    run.config()
    run.check()
    run.load_data()
    newest = run.checked_checkpoint(run.finished_iterations - 1)
    arrays.load_tree(newest, template)


def in_time(start: float) -> None:
    seconds.append(time.perf_counter() - start)
    assert seconds[-1] < SECONDS


def refused(read, *args) -> str:
    """The one line with which reading fails."""
    start = time.perf_counter()
    with pytest.raises((RunError, ConfigError)) as caught:
        read(*args)
    in_time(start)
    text = str(caught.value)
    assert "\n" not in text
    assert len(text) < 2000
    return text


def accepted_or_refused(read, *args) -> None:
    """A change that makes sense is taken; any other is refused as it should be."""
    start = time.perf_counter()
    try:
        read(*args)
    except HeadwayError as error:
        text = str(error)
    else:
        text = ""
    in_time(start)
    assert "\n" not in text
    assert len(text) < 2000


def test_the_sample_is_whole(root, template):
    read_all(root, template)


@pytest.mark.parametrize("name", damage.run_files(DATA / "run-schema-2"))
def test_damage_to_any_file_is_named(name, root, template):
    for content in list(damage.accidents(root, name)):
        (root / name).write_bytes(content)
        assert Path(name).name in refused(read_all, root, template)
    (root / name).unlink()
    if name != damage.NEWEST:  # without it the iteration before is the newest
        assert Path(name).name in refused(read_all, root, template)


def test_there_are_a_thousand_accidents(root):
    assert sum(1 for n in damage.run_files(root) for _ in damage.accidents(root, n)) >= 1000


def test_damage_to_the_newest_iteration_offers_the_one_before(root, template):
    for name in ("checkpoints/iteration-001.safetensors", damage.NEWEST, "data/iteration-001.json"):
        whole = (root / name).read_bytes()
        (root / name).write_bytes(whole[:-1])
        text = refused(read_all, root, template)
        assert "last good iteration is 0" in text
        assert "--resume-from-last-good" in text
        (root / name).write_bytes(whole)


@pytest.mark.parametrize("what", damage.HEADERS)
@pytest.mark.parametrize(
    "name", ["checkpoints/iteration-001.safetensors", "data/iteration-000.safetensors"]
)
def test_hostile_array_files(name, what, root, template):
    damage.reseal(root, name, damage.HEADERS[what])
    assert Path(name).name in refused(read_all, root, template)
    refused(arrays.load_arrays, root / name)


@pytest.mark.parametrize("what", damage.DOCUMENTS)
@pytest.mark.parametrize(
    "name", ["config.json", "data/iteration-000.json", "metrics.jsonl", damage.NEWEST]
)
def test_hostile_documents(name, what, root, template):
    damage.reseal(root, name, damage.DOCUMENTS[what])
    assert Path(name).name in refused(read_all, root, template)


ODD = [
    None,
    True,
    -1,
    10**10,
    10**19,
    0.5,
    "x",
    "../../x",
    [],
    [1] * 1000,
    {},
    {"a": 1},
    "x" * 10**5,
]


def test_hostile_settings(root, template):
    path = root / "config.json"
    whole = json.loads(path.read_text())
    for name in settings.setting_names(Config(env="pendulum")):
        section, _, field = name.rpartition(".")
        for value in ODD:
            values = json.loads(json.dumps(whole))
            (values["config"][section] if section else values["config"])[field] = value
            damage.reseal(root, "config.json", damage.sealed(values))
            accepted_or_refused(lambda: loading.need_of(RunDir(root).config()))


@pytest.mark.parametrize(
    "value",
    [
        {"train": {"length": [0.5], "mass": [1e400]}},
        {"train": {"length": [float("nan")], "mass": [1.0]}},
        {"train": {f"p{i}": [0.0, 1.0] for i in range(60)}},
        {"train": {f"p{i}": [1.0] for i in range(20_000)}},
        {"train": {"length": [10**300], "mass": [10**18]}, "unseen": {"train": {}}},
    ],
)
def test_hostile_physics(value, root):
    values = json.loads((root / "config.json").read_text())
    values["config"]["sim_params"] = value
    (root / "config.json").write_bytes(damage.sealed(values))
    refused(lambda: training.Arena.make(RunDir(root).config()))


def test_settings_never_name_code(root):
    for env in ("os:system", "headway.api:train", "../pendulum", "pendulum\0"):
        values = json.loads((root / "config.json").read_text())
        values["config"]["env"] = env
        damage.reseal(root, "config.json", damage.sealed(values))
        with pytest.raises(HeadwayError, match="unknown environment"):
            loading.load_agent(RunDir(root))


BAD_ROWS = [
    "tmcl,pendulum,0,0,low,length=1,0,nan,12",
    "tmcl,pendulum,0,0,low,length=1,0,1e999,12",
    "tmcl,pendulum,0,0,low,length=inf,0,1,12",
    "tmcl,pendulum,0,0,low,length=1,0,1",
    "tmcl,pendulum,0,0,low,length=1,0,1,12,12",
    "tmcl,pendulum,0,0,low,length,0,1,12",
    "tmcl,pendulum,0,x,low,length=1,0,1,12",
    f"tmcl,pendulum,0,{'9' * 30},low,length=1,0,1,12",
    f"tmcl,pendulum,0,{'9' * 5000},low,length=1,0,1,12",
    'tmcl,pendulum,0,0,"low,length=1,0,1,12',
    "tmcl,pendulum,0,0,low\0,length=1,0,1",
    "",
]


@pytest.mark.parametrize("row", BAD_ROWS)
def test_hostile_rows(row, root, template):
    content = (root / "evaluation.csv").read_text() + row + "\n"
    damage.reseal(root, "evaluation.csv", content.encode())
    assert "evaluation.csv" in refused(read_all, root, template)


@pytest.mark.parametrize("quote", ["", '"'])
def test_a_field_of_a_hundred_megabytes(quote, tmp_path):
    path = tmp_path / "evaluation.csv"
    header = ",".join(EVALUATION_COLUMNS) + "\n"
    path.write_text(header + quote + "x" * 10**8)
    assert "allowed: at most" in refused(records.read_csv, path, EVALUATION_COLUMNS)
    path.write_text(header + quote + "x" * 10**7)
    assert "field larger than" in refused(records.read_csv, path, EVALUATION_COLUMNS)


def test_millions_of_rows(tmp_path):
    path = tmp_path / "evaluation.csv"
    path.write_text(",".join(EVALUATION_COLUMNS) + "\n" + "m,e,0,0,g,,0,0,0\n" * 2_000_000)
    assert "more than 500,000 rows" in refused(records.read_csv, path, EVALUATION_COLUMNS)


@pytest.mark.parametrize("name", ["../outside.txt", "/etc/passwd", "data/../../x", "a\\..\\b", "."])
def test_manifests_name_files_of_the_run_only(name, root, template):
    manifest = json.loads((root / damage.NEWEST).read_text())
    manifest["files"][name] = {"bytes": 1, "sha256": "0" * 64}
    (root / damage.NEWEST).write_bytes(damage.sealed(manifest))
    (root.parent / "outside.txt").write_text("private")
    text = refused(read_all, root, template)
    assert "private" not in text


def change_manifest(root, key, value):
    manifest = json.loads((root / damage.NEWEST).read_text())
    manifest[key] = value
    (root / damage.NEWEST).write_bytes(damage.sealed(manifest))


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("files", {"config.json": {"bytes": 10**18, "sha256": "0"}}),
        ("files", {"config.json": {"bytes": "1", "sha256": "0"}}),
        ("files", {"config.json": 3}),
        ("files", [3]),
        ("files", {}),
        ("iteration", 7),
        ("iteration", -1),
        ("iteration", "1"),
        ("schema", 3),
    ],
)
def test_hostile_manifests(key, value, root, template):
    change_manifest(root, key, value)
    refused(read_all, root, template)


@pytest.mark.parametrize("name", ["config.json", "metrics.jsonl", "checkpoints", "data", "partial"])
def test_links_do_not_lead_out_of_the_run(name, root, template):
    outside = root.parent / "outside"
    if (root / name).exists():
        (root / name).rename(outside)
    else:
        outside.mkdir()
    (root / name).symlink_to(outside)
    if name == "partial":
        text = refused(training.train_run, RunDir(root).config(), root)
    else:
        text = refused(read_all, root, template)
    assert "outside of the run directory" in text


def test_writing_does_not_follow_a_link_that_lies_in_wait(root):
    victim = root.parent / "victim.txt"
    victim.write_text("mine")
    (root / ".evaluation.csv.writing").symlink_to(victim)
    RunDir(root).append_evaluation([])
    assert victim.read_text() == "mine"


@pytest.mark.parametrize("name", ["config.json", "metrics.jsonl", damage.NEWEST])
def test_what_is_no_regular_file_is_refused_at_once(name, root, template):
    (root / name).unlink()
    os.mkfifo(root / name)
    assert "no regular file" in refused(read_all, root, template)
    (root / name).unlink()
    (root / name).mkdir()
    refused(read_all, root, template)


@pytest.mark.parametrize("name", ["checkpoints/iteration-001.safetensors", "metrics.jsonl"])
def test_a_file_of_a_tebibyte_of_nothing(name, root, template):
    with (root / name).open("ab") as file:
        file.truncate(2**40)
    manifest = json.loads((root / damage.NEWEST).read_text())
    manifest["files"][name]["bytes"] = 2**40
    (root / damage.NEWEST).write_bytes(damage.sealed(manifest))
    assert Path(name).name in refused(read_all, root, template)


def resealed(name: str, content: bytes) -> bytes:
    """Give a changed configuration the checksum that it should have."""
    if name != "config.json":
        return content
    try:
        return damage.sealed(json.loads(content))
    except (ValueError, AttributeError):
        return content


@pytest.mark.parametrize(
    "name", ["config.json", *TEXTS, "data/iteration-001.json", "data/iteration-001.safetensors"]
)
def test_flips_that_the_checksums_were_fitted_to(name, root, template):
    rng = np.random.default_rng(1)
    whole = (root / name).read_bytes()
    for content in damage.flipped(whole, rng, 60):
        damage.reseal(root, name, resealed(name, content))
        accepted_or_refused(read_all, root, template)
