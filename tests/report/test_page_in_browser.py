"""The report as a person sees it: headless Chromium, at desktop and phone width."""

import io
import shutil

import numpy as np
import pytest
from PIL import Image

from headway.report.page.build import write_report
from runs import accept_changes

CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium-headless-shell", "chromium", "google-chrome"))), None
)
WIDTHS = {"desktop": (1280, 900), "phone": (360, 780)}
PAPER = {"light": (255, 255, 255), "dark": (0x17, 0x18, 0x1C)}

pytestmark = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium here: apt-get install chromium-headless-shell"
)


@pytest.fixture(scope="module")
def browser():
    api = pytest.importorskip("playwright.sync_api", reason="no Playwright: pip install playwright")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture(scope="module")
def report(tmp_path_factory, write_run, two_iterations):
    """Ten methods, so that legend and tables are crowded; one run is half finished.

    Two have three seeds, and so intervals; one run was really trained, and has contexts to show.
    """
    root = tmp_path_factory.mktemp("browser")
    for index in range(10):
        method = "tmcl" if index == 0 else f"method-number-{index}"
        heads = 3 if index < 2 else 1
        write_run(root / f"runs/{method}", method=method, heads=heads, evaluated=(1, 4))
        for seed in (1, 2) if index in (0, 2) else ():
            place = root / f"runs/{method}-{seed}"
            write_run(place, method=method, heads=heads, evaluated=(1, 4), seed=seed)
    shutil.copytree(two_iterations, root / "runs/trained")
    metrics = root / "runs/method-number-1/metrics.jsonl"
    metrics.write_text("".join(metrics.read_text().splitlines(keepends=True)[:2]))
    accept_changes(metrics.parent)
    return write_report([root / "runs"], root / "report.html")


@pytest.fixture(params=[("desktop", "light"), ("phone", "dark")], ids="-".join)
def opened(request, browser, report):
    """The page, what it said on the console, and what it asked for."""
    width, scheme = request.param
    context = browser.new_context(
        viewport=dict(zip(("width", "height"), WIDTHS[width], strict=True)), color_scheme=scheme
    )
    page = context.new_page()
    page.said, page.asked, page.scheme = [], [], scheme
    page.on("console", lambda message: page.said.append(message.text))
    page.on("pageerror", lambda error: page.said.append(str(error)))
    page.on("request", lambda request: page.asked.append(request.url))
    page.goto(report.as_uri())
    yield page
    context.close()


def test_it_fits_the_window_and_asks_for_nothing(opened, report):
    wide = opened.evaluate(
        """() => [...document.querySelectorAll("body *")].filter(
            (e) => !e.closest("svg, .scroll, textarea") &&
                   e.getBoundingClientRect().right > window.innerWidth + 1
        ).map((e) => e.tagName + " " + e.className)"""
    )
    assert wide == []
    assert opened.evaluate("document.documentElement.scrollWidth <= window.innerWidth")
    assert opened.said == []
    assert opened.asked == [report.as_uri()]


def test_every_kind_of_figure_is_there(opened):
    """Shaded intervals, bars, head shares, contexts and errors are drawn, and take up room."""
    for chapter in ("learning-curves", "groups", "head-shares", "contexts", "prediction-error"):
        boxes = opened.evaluate(
            """(id) => [...document.querySelectorAll(`#${id} figure svg`)].map((svg) => {
                const box = svg.getBoundingClientRect(); return [box.width, box.height];})""",
            chapter,
        )
        assert boxes, chapter
        assert min(min(box) for box in boxes) > 60, chapter
    assert opened.evaluate("document.body.innerText.includes('has no contexts to show')")
    bands = "#learning-curves figure svg [style*='fill-opacity: 0.16']"
    assert opened.locator(bands).count() == 2 * 4  # two methods with three seeds
    assert opened.locator("#contexts figure svg use").count() == 8 + 3  # moments, and the legend


def test_texts_of_figures_can_be_read_and_stay_inside(opened):
    sizes = opened.evaluate(
        """() => [...document.querySelectorAll("figure svg")].flatMap((svg) => {
            const box = svg.closest("figure").getBoundingClientRect();
            return [...svg.querySelectorAll("text")].map((text) => {
                const at = text.getBoundingClientRect();
                const scale = svg.getBoundingClientRect().width / svg.viewBox.baseVal.width;
                return [parseFloat(getComputedStyle(text).fontSize) * scale,
                        at.left >= box.left - 1 && at.right <= box.right + 1, text.textContent];
            });
        })"""
    )
    assert len(sizes) > 100
    assert min(size for size, _, _ in sizes) >= 8  # CSS pixels
    assert [text for _, inside, text in sizes if not inside] == []


def test_it_follows_the_theme_and_is_not_blank(opened):
    image = Image.open(io.BytesIO(opened.screenshot(full_page=True))).convert("RGB")
    pixels = np.asarray(image).reshape(-1, 3)
    paper = (np.abs(pixels.astype(int) - PAPER[opened.scheme]) < 10).all(1)
    assert 0.3 < paper.mean() < 0.97
    ink = opened.evaluate("getComputedStyle(document.querySelector('figure text')).fill")
    assert ink == {"light": "rgb(34, 34, 34)", "dark": "rgb(231, 231, 234)"}[opened.scheme]


def test_a_method_can_be_hidden_everywhere(opened):
    shown = """[...document.querySelectorAll(".series-2")].filter(
        (e) => getComputedStyle(e).display != "none").length"""
    before = opened.evaluate(shown)
    opened.uncheck("#show-2")
    assert before > 8
    assert opened.evaluate(shown) == 0
    opened.check("#show-2")
    assert opened.evaluate(shown) == before


def test_numbers_are_copied(opened):
    opened.click("text=Copy as CSV")
    assert opened.inner_text("[role=status]") in ("Copied.", "Selected: press Ctrl+C or ⌘C.")
    selected = opened.evaluate(
        "(t => t.value.slice(t.selectionStart, t.selectionEnd))(document.querySelector('textarea'))"
    )
    assert selected.startswith("env,method,seed")
    assert selected.count("\n") == 1 + (9 + 4) * 8
