"""Which runs stand for the same on the report page, and which are compared."""

import html
import re

from headway.report.page.build import write_report
from headway.report.page.measures import improvements_of
from headway.report.page.runs import load_runs
from headway.report.page.series import Comparison, series_labels


def text_of(page):
    return html.unescape(re.sub(r"<[^>]+>", " ", page))


def test_runs_that_were_not_tested_alike_are_not_compared(tmp_path, write_run):
    short = {"collection.episode_length": 50}
    for method, changed in (("tmcl", {}), ("pets", {}), ("mcl", short)):
        for seed in range(4):
            write_run(
                tmp_path / f"{method}-{seed}",
                method=method,
                seed=seed,
                lift=-900 * (method == "pets"),
                settings_changed=changed,
            )
    comparison = Comparison.of(*load_runs([tmp_path]))
    found = improvements_of(comparison)
    assert set(found) == {("tmcl", "pets"), ("pets", "tmcl")}
    only = ["improvement", "results"]
    said = text_of(write_report([tmp_path], tmp_path / "report.html", only=only).read_text())
    assert "tmcl is better than pets (probability of improvement 1.00" in said
    assert "options of the environment in pendulum, low; pendulum, high." in said


def test_two_seeds_claim_nothing(tmp_path, write_run):
    for method, seed in (("tmcl", 0), ("tmcl", 1), ("pets", 0), ("pets", 1)):
        write_run(tmp_path / f"{method}-{seed}", method=method, seed=seed, lift=500 * seed)
    page = write_report([tmp_path], tmp_path / "report.html").read_text()
    said = text_of(page)
    assert "2 seeds: too few to show that tmcl and pets differ (at least 3" in said
    assert "Fewer than 3 finished seeds: tmcl on pendulum (2); pets on pendulum (2)." in said
    assert "is better than" not in said
    assert not re.search(r"<small>[−\d.]+ to", page)


def test_variants_of_a_method_are_told_apart(tmp_path, write_run):
    for heads in (3, 5):
        for env in ("pendulum", "hopper"):
            if (heads, env) != (5, "hopper"):
                changed = {"model.num_heads": heads, "planner.horizon": 7 if env == "hopper" else 9}
                write_run(tmp_path / f"{env}-{heads}", env=env, settings_changed=changed)
    write_run(tmp_path / "other", method="pets")
    runs, _ = load_runs([tmp_path])
    assert sorted(set(series_labels(runs))) == ["pets", "tmcl, num heads 3", "tmcl, num heads 5"]
    page = write_report([tmp_path], tmp_path / "report.html", only=["settings"]).read_text()
    assert "model.num_heads" in page
    assert "planner.horizon" in page


def test_a_dash_stands_for_a_setting_that_a_method_cannot_use(tmp_path, write_run):
    for method, heads, length in (("tmcl", 3, 10), ("mcl", 3, 5), ("pets", 1, 7)):
        changed = {
            "model.num_heads": heads,
            "fitting.segment_length": length,
            "fitting.warmup_iterations": 3 if heads > 1 else 2,
        }
        write_run(tmp_path / method, method=method, settings_changed=changed)
    page = write_report([tmp_path], tmp_path / "report.html", only=["settings"]).read_text()
    rows = [re.findall(r"<t[hd][^>]*>(.*?)</t[hd]>", row) for row in page.split("<tr")]
    row = next(row for row in rows if row and "fitting.segment_length" in row[0])
    assert row[1:] == ["10", "5", "–"]
    assert "fitting.warmup_iterations" not in page  # all that use it agree


def test_presets_explain_what_follows_them(tmp_path, write_run):
    for preset, iterations in (("quick", 5), ("paper", 10)):
        for seed in range(2):
            changed = {
                "preset": preset,
                "planner.horizon": iterations,
                "fitting.epochs": iterations,
            }
            write_run(
                tmp_path / f"{preset}-{seed}",
                seed=seed,
                iterations=iterations,
                settings_changed=changed,
            )
    runs, _ = load_runs([tmp_path])
    assert set(series_labels(runs)) == {"tmcl, preset quick", "tmcl, preset paper"}
    changed = {"preset": "quick", "planner.horizon": 7, "fitting.epochs": 5}
    write_run(tmp_path / "other", settings_changed=changed)
    runs, _ = load_runs([tmp_path])
    assert set(series_labels(runs)) == {
        "tmcl, preset quick, horizon 5",
        "tmcl, preset quick, horizon 7",
        "tmcl, preset paper, horizon 10",
    }


def test_labels_are_short_and_not_ambiguous(tmp_path, write_run):
    for index, counts in enumerate([(4, 8), (8, 4)]):
        changed = dict(
            zip(("collection.num_episodes", "evaluation.num_episodes"), counts, strict=True)
        )
        write_run(tmp_path / f"{index}", settings_changed=changed)
    runs, _ = load_runs([tmp_path])
    assert set(series_labels(runs)) == {
        "tmcl, collection num episodes 4, evaluation num episodes 8",
        "tmcl, collection num episodes 8, evaluation num episodes 4",
    }
    for index in range(2):
        changed = {"planner.horizon": 5, "planner.num_candidates": 90, "model.num_heads": 2 + index}
        write_run(tmp_path / f"more{index}", settings_changed=changed)
    labels = series_labels(load_runs([tmp_path])[0])
    assert len(set(labels)) == 4
    assert max(map(len, labels)) < 80
    assert {label[-9:] for label in labels} == {f"variant {i}" for i in range(1, 5)}


def test_what_is_tolerated_of_an_environment_makes_no_variant(tmp_path, write_run):
    separate = {"collection.env_processes": True}
    for seed, changed in enumerate([{}, separate, {}]):
        write_run(tmp_path / f"seed{seed}", seed=seed, settings_changed=changed)
    write_run(tmp_path / "seed2-again", seed=2, settings_changed=separate)
    runs, notes = load_runs([tmp_path])
    assert series_labels(runs) == ["tmcl"] * 3
    assert [note.text for note in notes] == [
        f"left out: same settings and seed as {tmp_path / 'seed2'}."
    ]


def test_settings_that_a_run_cannot_use_make_no_variants(tmp_path, write_run):
    for seed, transitions in ((0, 0), (1, 20)):
        changed = {
            "fitting.relation_transitions": transitions,
            "planner.optimizer.temperature": 1.0 + seed,
        }
        write_run(tmp_path / f"seed{seed}", seed=seed, settings_changed=changed)
    changed = {"planner.optimizer.temperature": 9.0}
    write_run(tmp_path / "seed1-again", seed=1, settings_changed=changed)
    runs, notes = load_runs([tmp_path])
    assert series_labels(runs) == ["tmcl", "tmcl"]
    assert [note.run.name for note in notes] == ["seed1-again"]
    page = write_report([tmp_path], tmp_path / "report.html", only=["settings"]).read_text()
    assert "All runs have the same settings." in page
