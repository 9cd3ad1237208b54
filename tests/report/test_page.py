"""The report's page: what it says, what it survives, and that it needs nothing else."""

import csv
import dataclasses
import html
import io
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

import headway
from headway.cli import main
from headway.errors import ConfigError, RunError, UnknownNameError
from headway.report.page import svg
from headway.report.page.build import SECTIONS, write_report
from headway.report.page.contexts import principal_components, variance_between
from headway.report.page.runs import load_runs, train_command
from headway.report.page.series import Comparison
from headway.report.page.svg import THEME
from headway.training.run import RunDir
from runs import accept_changes

HOSTILE = '<script>alert("1")</script>&amp;$x_{2}$'


@pytest.fixture
def folder(tmp_path, write_run):
    """Two methods on Pendulum over three seeds, with both references."""
    root = tmp_path / "runs"
    for method, lift in (
        ("tmcl", 0.0),
        ("pets", -150.0),
        ("random", -900.0),
        ("true-dynamics", 300),
    ):
        for seed in range(3):
            write_run(root / f"{method}-{seed}", method=method, seed=seed, lift=lift)
    return root


@pytest.fixture
def pair(tmp_path, write_run):
    """Two runs of one method."""
    for seed in (0, 1):
        write_run(tmp_path / f"pair/tmcl-{seed}", seed=seed)
    return tmp_path / "pair"


def text_of(page):
    return html.unescape(re.sub(r"<[^>]+>", " ", page))


def section(page, name):
    return re.search(rf'<section id="{name}">.*?</section>', page, re.DOTALL)[0]


def numbers(page):
    text = re.search(r"<textarea.*?>(.*?)</textarea>", page, re.DOTALL)[1]
    return list(csv.DictReader(io.StringIO(html.unescape(text))))


def test_the_page_holds_every_chapter_and_needs_nothing_else(folder, tmp_path):
    out = write_report([folder], tmp_path / "report.html")
    page = out.read_text()
    assert re.findall(r'<section id="([\w-]+)">', page) == list(SECTIONS)
    for name in SECTIONS:
        assert f"headway report {folder} -o {out} --only {name}" in text_of(section(page, name))
    for name in ("learning-curves", "groups", "head-shares", "prediction-error", "times"):
        assert "<path" in section(page, name)
    # Nothing is loaded from anywhere; XML names of namespaces are no addresses.
    assert not re.findall(r'(?:src|href)="(?!#|data:)', page)
    assert not re.findall(r"@import|url\((?!#)(?!\"?#)", page)
    assert "default-src 'none'" in page
    ids = re.findall(r' id="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    for target in re.findall(r'(?:href="|url\()#([^")]+)', page):
        assert target in ids


def test_raw_numbers_are_those_of_the_runs(folder, tmp_path):
    page = write_report([folder], tmp_path / "report.html", only=["numbers"]).read_text()
    rows = numbers(page)
    assert {row["method"] for row in rows} == {"tmcl", "pets", "random", "true-dynamics"}
    assert len(rows) == 4 * 3 * 8
    row = next(r for r in rows if (r["method"], r["seed"]) == ("pets", "1"))

    def mean(method, seed):
        episodes = RunDir(folder / f"{method}-{seed}").evaluation()
        same = [e for e in episodes if (e.group, e.sim_params["length"]) == ("train", 0.5)]
        return np.mean([e.episode_return for e in same])

    assert row["sim_params"] == "length=0.5 mass=1"
    assert float(row["return_mean"]) == pytest.approx(mean("pets", 1), abs=1e-3)
    random, ceiling = (np.mean([mean(m, s) for s in range(3)]) for m in ("random", "true-dynamics"))
    score = (mean("pets", 1) - random) / (ceiling - random)
    assert float(row["score"]) == pytest.approx(score, abs=1e-3)


def test_references_that_planned_otherwise_are_not_averaged(tmp_path, write_run):
    def write(name, method, lift, horizon):
        changed = {"planner.horizon": horizon}
        write_run(tmp_path / name, method=method, lift=lift, settings_changed=changed)

    write("random", "random", -900, 20)
    for name, lift, horizon in (("short", 100, 10), ("long", 300, 30)):
        write(name, "true-dynamics", lift, horizon)
        write(f"tmcl-{name}", "tmcl", 0, horizon)
    write("pets", "pets", 0, 20)
    comparison = Comparison.of(*load_runs([tmp_path]))
    scores = {label: run["low"].score for (_, label), (run,) in comparison.outcomes.items()}
    assert scores == {
        "tmcl, horizon 10": pytest.approx(900 / 1000),
        "tmcl, horizon 30": pytest.approx(900 / 1200),
        "pets": None,
    }
    (note,) = comparison.notes
    assert note.run.name == "pets"
    assert "planned in several ways" in note.text
    runs = comparison.runs_of("pendulum")
    assert comparison.references.level("true-dynamics", runs, "low") is None
    assert comparison.references.level("true-dynamics", runs[:1], "low") is not None
    page = write_report([tmp_path], tmp_path / "report.html", only=["runs", "numbers"]).read_text()
    for name in ("random", "short", "long"):
        assert str(tmp_path / name) in section(page, "runs")
    assert {row["run"] for row in numbers(page)} == {
        str(run.path) for run in load_runs([tmp_path])[0]
    }


def test_results_and_verdicts(folder, tmp_path):
    page = write_report(
        [folder], tmp_path / "report.html", only=["results", "improvement"]
    ).read_text()
    rows = numbers(write_report([folder], tmp_path / "n.html", only=["numbers"]).read_text())
    low = [r for r in rows if (r["method"], r["group"]) == ("tmcl", "low")]
    scores = [np.mean([float(r["score"]) for r in low if r["seed"] == s]) for s in "012"]
    results = text_of(section(page, "results"))
    assert f"{np.mean(scores):.2f}" in results
    assert "normalised by the runs of random and true-dynamics given here" in results
    assert "fewer than 10 seeds are too narrow" in results
    said = "3 seeds: too few to show that tmcl and pets differ (the clearest result has p = 0.1)"
    assert f"{said}; tmcl is above pets in every pair of runs." in text_of(page)


def test_the_projects_references_are_taken_where_no_run_is_one(tmp_path, write_run):
    write_run(tmp_path / "a")
    page = write_report([tmp_path / "a"], tmp_path / "report.html").read_text()
    assert "normalised by the project's reference returns" in text_of(page)
    (row, *_) = numbers(page)
    assert row["sim_params"] == "length=0.5 mass=1"
    score = (float(row["return_mean"]) + 1501) / (-126 + 1501)
    assert float(row["score"]) == pytest.approx(score, abs=1e-3)


def test_a_run_is_not_counted_twice(folder, tmp_path):
    shutil.copytree(folder / "tmcl-0", tmp_path / "copy")
    runs, notes = load_runs([tmp_path / "copy", folder, folder / "tmcl-0"])
    assert len(runs) == 12
    assert [note.text for note in notes] == [
        f"left out: same settings and seed as {tmp_path / 'copy'}."
    ]


@pytest.mark.parametrize(
    ("name", "lost"),
    [
        ("config.json", "left out"),
        ("metrics.jsonl", "no learning curve, run time or final result"),
        ("evaluation.csv", "no final result"),
        ("assignments.csv", "no head shares"),
        ("prediction_error.csv", "no prediction errors"),
    ],
)
def test_damage_costs_one_line(pair, tmp_path, name, lost):
    (pair / "tmcl-1" / name).write_bytes(b"\xff\x00 not what it was\n")
    page = write_report([pair], tmp_path / "report.html").read_text()
    notes = re.findall(r"<li><code>(.*?)</code> (.*?)</li>", page)
    assert [run for run, _ in notes[:1]] == [str(pair / "tmcl-1")]
    assert notes[0][1].startswith(lost)
    assert re.findall(r'<section id="([\w-]+)">', page) == list(SECTIONS)


def test_numbers_out_of_range_are_drawn_all_the_same(pair, tmp_path):
    table = pair / "tmcl-0/assignments.csv"
    table.write_text(
        re.sub(r",[\d.]+$", ",nan", table.read_text().replace(",0.0", ",7.0"), flags=re.M)
    )
    errors = pair / "tmcl-0/prediction_error.csv"
    errors.write_text(errors.read_text() + "4,low,21,inf\n4,high,21,nan\n4,far,1,nan\n")
    accept_changes(pair / "tmcl-0")
    chosen = ["head-shares", "prediction-error"]
    page = write_report([pair], tmp_path / "report.html", only=chosen).read_text()
    assert page.count("<figure>") == 2 + 3  # runs, groups with a finite error


def test_unfinished_runs_have_curves_but_no_final_results(folder, tmp_path):
    lines = (folder / "tmcl-2/metrics.jsonl").read_text().splitlines(keepends=True)
    (folder / "tmcl-2/metrics.jsonl").write_text("".join(lines[:3]))
    accept_changes(folder / "tmcl-2")
    page = write_report([folder], tmp_path / "report.html").read_text()
    assert "3 of 5 iterations are finished" in page
    assert {row["seed"] for row in numbers(page) if row["method"] == "tmcl"} == {"0", "1"}
    assert "tmcl on pendulum (2)" in page
    (folder / "tmcl-2/metrics.jsonl").write_text("")
    accept_changes(folder / "tmcl-2")
    assert (
        "0 of 5 iterations are finished" in write_report([folder], tmp_path / "b.html").read_text()
    )


def test_names_with_html_are_only_text(tmp_path, write_run):
    path = write_run(tmp_path / "a<b>&'c", method=HOSTILE)
    config = json.loads((path / "config.json").read_text())
    config["device"] = HOSTILE
    config["config"]["env"] = HOSTILE
    (path / "config.json").write_text(json.dumps(config))
    for table in ("evaluation.csv", "prediction_error.csv"):
        text = (path / table).read_text().replace(",low,", ',"' + HOSTILE.replace('"', '""') + '",')
        (path / table).write_text(text)
    accept_changes(path)
    page = write_report([path], tmp_path / "report.html").read_text()
    assert page.count("<script") == 1
    assert "<b>" not in page
    assert HOSTILE in text_of(page)
    bars = re.findall(r"<text[^>]*>(.*?)</text>", section(page, "groups"))
    assert HOSTILE in map(html.unescape, bars)  # as it is, not as mathematics


def test_contexts_are_drawn_from_the_checkpoint(two_iterations, tmp_path):
    page = write_report([two_iterations], tmp_path / "report.html", only=["contexts"]).read_text()
    assert "between physics: 0." in page
    assert "1st component" in page
    path = Path(shutil.copytree(two_iterations, tmp_path / "run"))
    shutil.rmtree(path / "data")
    page = write_report([path], tmp_path / "b.html", only=["contexts"]).read_text()
    assert f"{path} has no contexts to show: " in text_of(page)


def test_colours_follow_the_theme(two_iterations, tmp_path):
    lights = [light for light, _ in THEME.values()]
    assert len(set(lights)) == len(lights)
    page = write_report([two_iterations], tmp_path / "report.html", only=["contexts"]).read_text()
    figure = re.search(r"<figure>.*?</figure>", page, re.DOTALL)[0]
    assert "#" not in re.sub(r'(?:href="|url\()#', "", figure)  # no colour but the theme's
    used = set(re.findall(r"fill: var\(--(p\d+)\)", figure))
    physics = {tuple(t.sim_params.items()) for t in RunDir(two_iterations).load_data()}
    assert len(used) == len(physics) > 1


def test_a_method_without_a_model_has_every_chapter(tmp_path):
    run = headway.train("pendulum", method="random", preset="smoke", run_dir=tmp_path / "run")
    page = write_report([run.path], tmp_path / "report.html").read_text()
    assert re.findall(r'<section id="([\w-]+)">', page) == list(SECTIONS)
    assert "No learned context: random, seed 0." in page


def test_episodes_shorter_than_the_history_have_no_contexts(two_iterations, tmp_path, monkeypatch):
    short = [
        dataclasses.replace(t, obs=t.obs[:11], action=t.action[:10], reward=t.reward[:10])
        for t in RunDir(two_iterations).load_data()
    ]
    monkeypatch.setattr(RunDir, "load_data", lambda self: short)
    page = write_report([two_iterations], tmp_path / "report.html", only=["contexts"]).read_text()
    assert (
        f"{two_iterations} has no contexts to show: none of its collected episodes is"
        in text_of(page)
    )


def test_only_coordinates_are_shortened():
    def draw(axes):
        axes.plot([0.0, 1 / 3], [0.0, 1.0])
        axes.set_xticks([0.0005, 0.375], ["0.0005", 'x="0.375"'])

    drawn = svg.panel(draw, name="a", label="learning rate 0.00025")
    assert 'aria-label="learning rate 0.00025"' in drawn
    texts = map(html.unescape, re.findall(r"<text[^>]*>(.*?)</text>", drawn))
    assert {"0.0005", 'x="0.375"'} <= set(texts)
    assert re.search(r' d="M \d+\.\d', drawn)
    assert not re.search(r' (?:d|x|y|transform)="[^"<>]*\.\d\d\d', drawn)


def test_principal_components():
    rng = np.random.default_rng(0)
    spread = rng.normal(size=(200, 3)) * [0.1, 5.0, 1.0]
    turned = spread @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    points, explained = principal_components(turned)
    assert np.abs(np.corrcoef(points[:, 0], spread[:, 1])[0, 1]) > 0.999
    assert np.abs(np.corrcoef(points[:, 1], spread[:, 2])[0, 1]) > 0.999
    variances = spread.var(0)
    np.testing.assert_allclose(explained, variances[[1, 2]] / variances.sum(), rtol=0.02)
    points, explained = principal_components(rng.normal(size=(5, 1)))
    assert points.shape == (5, 2)
    np.testing.assert_allclose(explained, [1, 0])


def test_variance_between_physics():
    physics = [{"m": 1.0}, {"m": 1.0}, {"m": 2.0}, {"m": 2.0}]
    assert variance_between(np.array([[0.0], [0.0], [3.0], [3.0]]), physics) == 1
    assert variance_between(np.array([[1.0], [3.0], [1.0], [3.0]]), physics) == 0
    assert variance_between(np.array([[0.0], [2.0], [2.0], [4.0]]), physics) == pytest.approx(0.5)


@pytest.mark.parametrize("own_physics", [False, True])
def test_the_train_command_makes_the_same_configuration(
    tmp_path, write_run, monkeypatch, own_physics
):
    from headway.cli import parse
    from headway.training.methods import make_config

    changed = {"model.hidden_sizes": [32, 32], "fitting.bootstrap": True, "planner.horizon": 7,
               "model.backward_net": False}  # fmt: skip
    if own_physics:
        changed["sim_params"] = {
            "train": {"length": [0.5, 0.6]},
            "unseen": {"low": {"length": [0.25]}, "high": {"length": [1.5]}},
        }
    write_run(tmp_path / "a", seed=4, method="mcl", settings_changed=changed)
    (run,), _ = load_runs([tmp_path / "a"])
    program, command, *words = train_command(run)
    assert (program, command) == ("headway", "train")
    page = write_report([tmp_path / "a"], tmp_path / "report.html", only=["runs"]).read_text()
    written = re.search(r"sim_params.json: ({.*?})<", html.unescape(page))
    assert (written is not None) == own_physics
    if written:
        monkeypatch.chdir(tmp_path)
        Path("sim_params.json").write_text(written[1])
    arguments = parse([command, *words])
    names = {"method": arguments.method, "preset": arguments.preset, "seed": arguments.seed}
    assert make_config(arguments.env, **names, settings=arguments.settings()) == run.config
    assert arguments.run_dir == tmp_path / "a"


def test_report_command(folder, tmp_path, capsys):
    out = tmp_path / "sub" / "page.html"
    assert main(["report", str(folder), "-o", str(out), "--only", "results", "runs"]) == 0
    assert capsys.readouterr().out.strip() == str(out)
    assert re.findall(r'<section id="([\w-]+)">', out.read_text()) == ["results", "runs"]
    assert main(["report", str(folder), "-o", str(out), "--only", "runs", "--json"]) == 0
    assert json.loads(capsys.readouterr().out) == {"report": str(out)}


def test_what_cannot_be_reported(tmp_path, write_run):
    with pytest.raises(ConfigError, match="no run is given"):
        write_report([])
    with pytest.raises(RunError, match="not a directory"):
        write_report([tmp_path / "nothing"])
    with pytest.raises(RunError, match="holds no run"):
        write_report([tmp_path])
    write_run(tmp_path / "a")
    with pytest.raises(UnknownNameError, match="Did you mean 'contexts'"):
        headway.write_report([tmp_path / "a"], only=["context"])
    (tmp_path / "a/config.json").write_text("{}")
    with pytest.raises(RunError, match="none of 1 runs can be read"):
        write_report([tmp_path / "a"])


def test_references_alone_are_compared_like_methods(tmp_path, write_run):
    write_run(tmp_path / "a", method="random")
    comparison = Comparison.of(*load_runs([tmp_path / "a"]))
    assert [series.label for series in comparison.series] == ["random"]
