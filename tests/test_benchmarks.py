"""The tools of the benchmarks: what they compute from what was measured."""

import json
from pathlib import Path

import pytest
from growth import exponent
from hlo_parts import ACTIVATION, NOISE, PRODUCTS, RULES, SAMPLING, SEARCH, TASK, Module
from machine import machine_kind
from op_trace import Operation, Span, exclusive_seconds
from profile_plan import OVERHEAD, profile
from reporting import NOT_MEASURED, Report, markdown_table
from save import save
from targets import Target
from workloads import make_agent

import headway
from headway.config import CEMConfig, MultiHeadedConfig, PlannerConfig

PLAN = Target("plan", "cpu", "a plan", 0.8, "ratio", "")
RATE = Target("updates", "cpu", "updates", 100.0, "value", "/s", "at least")
GPU_PLAN = Target("plan", "gpu", "a plan", 4.0, "ratio", "")


@pytest.mark.parametrize(
    ("backend", "device", "kind"),
    [
        ("cpu", "cpu", "cpu-2-cores"),
        ("gpu", "NVIDIA H100 80GB HBM3", "h100"),
        ("gpu", "NVIDIA A100-SXM4-40GB", "a100"),
        ("gpu", "NVIDIA GeForce RTX 4090", "rtx-4090"),
    ],
)
def test_machine_kind_names_the_device(backend, device, kind):
    assert machine_kind(backend, device, 2, matrix_units=False) == kind


def test_machine_kind_tells_cpus_with_matrix_units_apart():
    assert machine_kind("cpu", "cpu", 2, matrix_units=True) == "cpu-2-cores-amx"
    assert machine_kind("gpu", "NVIDIA H100", 2, matrix_units=True) == "h100"


def test_report_sets_targets_beside_what_was_measured():
    report = Report([PLAN, RATE, GPU_PLAN])
    report.add("plan", 2.0, "s", ratio=0.9, ratio_to="products", key="plan")
    report.add("updates", 100.0, "/s", key="updates")
    plan, updates, gpu_plan = report.rows("cpu")
    assert (plan["target"], plan["met"]) == ("≤ 0.8×", False)
    assert (updates["target"], updates["met"]) == ("≥ 100 /s", True)
    assert gpu_plan == {"name": "a plan (GPU)", "target": "≤ 4×"}


def test_report_writes_json_and_a_table(tmp_path, monkeypatch):
    monkeypatch.setattr("reporting.LATEST", tmp_path / "latest")
    report = Report([PLAN, GPU_PLAN])
    report.add("plan", 2.0, "s", ratio=0.75, ratio_to="products", key="plan")
    table = report.write("bench")
    assert (tmp_path / "latest/bench.md").read_text() == table
    result = json.loads((tmp_path / "latest/bench.json").read_text())
    assert result["kind"].startswith("cpu-")
    assert result["measurements"][0]["met"] is True
    measured, missing = table.strip().splitlines()[-2:]
    assert "2 s" in measured
    assert "0.75×" in measured
    assert measured.endswith("| met |")
    assert NOT_MEASURED in missing


def test_markdown_columns_are_aligned():
    table = markdown_table(["a", "long head"], [["wide cell", "b"]])
    assert {len(line) for line in table.splitlines()} == {len("| wide cell | long head |")}


def test_saved_results_go_to_the_machines_folder(tmp_path):
    latest = tmp_path / "latest"
    latest.mkdir()
    about = json.dumps({"kind": "h100", "date": "2026-01-02"})
    for name in ("bench.json", "growth.json"):
        (latest / name).write_text(about)
    (latest / "growth.png").write_bytes(b"picture")
    saved = save(latest, tmp_path / "speed")
    assert [path.name for path in saved] == [
        "2026-01-02.json",
        "2026-01-02-growth.json",
        "2026-01-02-growth.png",
    ]
    assert (tmp_path / "speed/h100/2026-01-02-growth.png").read_bytes() == b"picture"


def test_exponent_is_that_of_the_upper_half():
    points = [(1, 7.0), (2, 7.0), (4, 7.0), (16, 16.0**1.3), (64, 64.0**1.3)]
    assert exponent(points) == pytest.approx(1.3)


def test_time_belongs_to_the_operation_that_began_last():
    spans = [
        Span(Operation("m", "loop"), 0.0, 10.0),
        Span(Operation("m", "product"), 1.0, 7.0),  # its end is noted late
        Span(Operation("n", "product"), 4.0, 6.0),
    ]
    assert list(exclusive_seconds(spans).values()) == [1 + 3, 3 + 1, 2]


@pytest.fixture(scope="module")
def small_plan():
    model = MultiHeadedConfig(num_members=2, hidden_sizes=(8, 8), context_hidden_sizes=(8,))
    planner = PlannerConfig(
        horizon=2,
        num_candidates=8,
        optimizer=CEMConfig(num_elites=2),
        num_iterations=2,
        num_particles=2,
    )
    agent, state, obs = make_agent(1, model, planner)
    return lambda: agent.act(state, obs)


def test_the_profile_looks_for_functions_that_there_are():
    source = Path(headway.__file__).parent
    for path, function, _ in RULES:
        files = [file for file in source.rglob("*.py") if path in str(file)]
        name = function.rsplit(".", 1)[-1]
        assert any(name in file.read_text() for file in files), (path, function)


def test_profile_finds_the_parts_of_a_plan(small_plan):
    found = profile(small_plan, rounds=1)
    assert {PRODUCTS, ACTIVATION, NOISE, SAMPLING, TASK, SEARCH, OVERHEAD} <= set(found.parts)
    assert sum(found.parts.values()) == pytest.approx(found.traced)
    assert found.parts.get("other", 0.0) < 0.1 * found.traced
    for shares in found.shares.values():
        assert sum(shares.values()) == pytest.approx(1.0)


MODULE = """HloModule jit_step

FileNames
1 "/site-packages/somewhere.py"
2 "/src/headway/envs/locomotion.py"

FunctionNames
1 "helper"
2 "HopperTask.reward"

FileLocations
1 {file_name_id=2 function_name_id=2 line=1}
2 {file_name_id=1 function_name_id=1 line=1}

StackFrames
1 {file_location_id=1 parent_frame_id=1}
2 {file_location_id=2 parent_frame_id=2}

%fused (p: f32[10]) -> f32[10] {
  %p = f32[10]{0} parameter(0)
  %double = f32[10]{0} add(%p, %p), metadata={op_name="jit(step)/add" stack_frame_id=2}
  ROOT %noise = f32[10]{0} exponential(%double), metadata={op_name="jit(step)/jit(_normal)/exp"}
}

ENTRY %main (x: f32[10]) -> f32[10] {
  %x = f32[10]{0} parameter(0)
  %dot.1 = f32[10]{0} dot(%x, %x), metadata={op_name="jit(step)/dot_general" stack_frame_id=2}
  ROOT %both = f32[10]{0} fusion(%dot.1), kind=kLoop, calls=%fused
}
"""


def test_operations_get_the_part_of_the_innermost_function_that_is_known():
    operations = {one.name: shares for one, shares in Module(MODULE).operations()}
    assert set(operations) == {"x", "dot.1", "both"}
    assert operations["dot.1"] == {PRODUCTS: 1.0}
    assert operations["both"] == pytest.approx({TASK: 1 / 31, NOISE: 30 / 31})
