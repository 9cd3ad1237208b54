"""The report: what it says, that it needs nothing else, and how it looks in a browser."""

import base64
import html
import io
import os
import re
import shutil

import fakes
import numpy as np
import pandas as pd
import pytest
from PIL import Image

from headway.errors import ConfigError
from headway.lab import diagnose
from headway.lab.report import write_report

CHAPTERS = [
    "results", "learning-curves", "physics", "improvement", "head-shares", "prediction-error",
    "settings", "runs", "numbers",
]  # fmt: skip
HOSTILE = '<script>alert("1")</script>&amp;$x_{2}$'


def text_of(page):
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", page)).split())


def section(page, name):
    return re.search(rf'<section id="{name}">.*?</section>', page, re.DOTALL)[0]


def numbers(page):
    content = re.search(r'href="data:text/csv;charset=utf-8;base64,([^"]*)"', page)[1]
    return pd.read_csv(io.BytesIO(base64.b64decode(content)))


def report(root):
    return write_report([root], root.parent / "report.html")


@pytest.fixture(scope="module")
def made(written, tmp_path_factory):
    """A page of two methods over three seeds with both references, and an unfinished run."""
    root = shutil.copytree(written, tmp_path_factory.mktemp("report") / "runs")
    unfinished = fakes.write(root / "tmcl-3", seed=3) / "metrics.jsonl"
    unfinished.write_text("".join(unfinished.read_text().splitlines(keepends=True)[:3]))
    return report(root)


def test_the_page_holds_every_chapter_of_tables_and_needs_nothing_else(made):
    page = made.read_text()
    assert re.findall(r'<section id="([\w-]+)">', page) == CHAPTERS
    for name in ("learning-curves", "physics", "head-shares", "prediction-error"):
        assert "<path" in section(page, name)
    assert not re.findall(r'(?:src|href)="(?!#|data:)', page)
    assert not re.findall(r"@import|url\((?!#)(?!\"?#)", page)
    assert "<script" not in page
    ids = re.findall(r' id="([^"]+)"', page)
    for target in re.findall(r'(?:href="|url\()#([^")]+)', page):
        assert target in ids
    assert f"headway report {made.parent / 'runs'} -o {made}" in text_of(page)


def test_results_and_claims_are_those_of_the_numbers(made):
    page = made.read_text()
    rows = numbers(page)
    assert len(rows) == 4 * 3 * 8
    scores = rows.query("method == 'tmcl' and group == 'low'").groupby("seed").score.mean()
    assert list(scores.index) == [0, 1, 2]
    results = text_of(section(page, "results"))
    assert f"{scores.mean():.2f}" in results
    assert "normalised by the runs of random and true-dynamics given here" in results
    assert "fewer than 10 seeds are too narrow" in results
    said = "3 seeds: too few to show that tmcl and pets differ (the clearest result has p = 0.1)"
    assert f"{said}; tmcl is above pets in every pair of runs." in text_of(page)
    assert "3 of 5 iterations are finished" in text_of(page)


def test_a_trained_run_has_its_film_diagnosis_and_episode(reference, tmp_path, monkeypatch):
    path = shutil.copytree(reference, tmp_path / "runs/a")
    for age, name in enumerate(["new.mp4", "old.gif"]):
        (path / name).write_bytes(name.encode())
        os.utime(path / name, (1e9 - age, 1e9 - age))
    page = report(tmp_path / "runs").read_text()
    assert re.findall(r'<section id="([\w-]+)">', page) == [
        "results", "films", "learning-curves", "physics", "head-shares", "diagnosis", "episode",
        "runs", "numbers",
    ]  # fmt: skip
    assert re.findall(r'src="([^"]*)"', page) == ["data:video/mp4;base64,bmV3Lm1wNA=="]
    said = text_of(section(page, "diagnosis"))
    for table in diagnose.tables(diagnose.diagnose(reference)):
        for cells in zip(*(column.cells for column in table.columns), strict=True):
            assert " ".join(" ".join(cells).split()) in said
    assert len(re.findall("<figure>", section(page, "episode"))) == 5
    assert "return per episode by physics" in section(page, "physics")

    monkeypatch.setattr("headway.lab.report.ROOM", 0)
    (path / "tests/iteration-002.safetensors").write_bytes(b"")
    page = report(tmp_path / "runs").read_text()
    for name, note in (("films", "new.mp4 is left out"), ("diagnosis", "no diagnosis: ")):
        assert f'"{name}"' not in page
        assert f"<code>{path}</code> {note}" in page


def test_few_seeds_have_no_interval_and_no_claim(tmp_path):
    for method in ("tmcl", "pets"):
        fakes.write(tmp_path / f"runs/{method}", method, lift=len(method))
    page = report(tmp_path / "runs").read_text()
    results = text_of(section(page, "results"))
    assert "Fewer than 3 finished seeds: tmcl on pendulum (1); pets on pendulum (1)." in results
    assert not re.search(r"\d to [−\d]", results)
    assert "is better than" not in page


def test_nothing_finished_leaves_chapters_out(run_dir):
    for name in ("metrics.jsonl", "evaluation.csv", "assignments.csv", "prediction_error.csv"):
        (run_dir / name).write_bytes(b"\xff no\n")
    page = report(run_dir).read_text()
    assert page.count(f"<li><code>{run_dir}</code>") == 5  # one for each, and what is missing
    assert re.findall(r'<section id="([\w-]+)">', page) == ["runs"]
    assert re.findall(r'<a href="#([\w-]+)">', page) == ["runs"]
    with pytest.raises(ConfigError, match="no run is given"):
        write_report([])


def test_several_environments_are_taken_together(tmp_path):
    for env in ("pendulum", "own"):
        for method, lift in fakes.LIFTS.items():
            fakes.write(tmp_path / f"runs/{env}-{method}", method, env=env, lift=lift)
    page = report(tmp_path / "runs").read_text()
    assert "All environments" in section(page, "results")
    assert page.count("<h3>own</h3>") == page.count("<h3>pendulum</h3>") > 1


def test_names_with_html_are_only_text(tmp_path):
    path = fakes.write(tmp_path / "a<b>&'c", HOSTILE, env=HOSTILE)
    for table in ("evaluation.csv", "prediction_error.csv"):
        text = (path / table).read_text().replace(",low,", ',"' + HOSTILE.replace('"', '""') + '",')
        (path / table).write_text(text)
    page = report(path).read_text()
    assert "<script" not in page
    assert "<b>" not in page
    assert HOSTILE in html.unescape(page)


@pytest.mark.parametrize(("scheme", "width"), [("light", 1280), ("dark", 360)])
def test_the_page_in_a_browser(browser, made, scheme, width):
    page = browser.new_page(viewport={"width": width, "height": 800}, color_scheme=scheme)
    page.set_default_timeout(120_000)
    errors = []
    page.on("console", lambda message: errors.append(message.text))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("request", lambda request: errors.append(request.url))
    page.goto(made.as_uri())
    assert [error for error in errors if not error.startswith("data:")] == [made.as_uri()]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    picture = np.asarray(Image.open(io.BytesIO(page.screenshot())).convert("RGB"))
    paper = {"light": (255, 255, 255), "dark": (0x17, 0x18, 0x1C)}[scheme]
    assert tuple(picture[5, 5]) == paper
    line = page.locator("#results .series-1").first
    assert line.is_visible()
    page.locator("#show-1").uncheck()
    assert not line.is_visible()
    page.close()
