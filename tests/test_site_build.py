"""The site of `make docs`, built and opened: slow, and only where what builds it is installed."""

import html
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium-headless-shell", "chromium", "google-chrome"))), None
)
LOADED = re.compile(r"<(?:link|script|img|iframe)\b[^>]*\b(?:src|href)=\"(?:https?:)?//[^\"]*\"")
PAGES = ["index", "docs/methods", "results/README"]
PAGES += [f"docs/site/reference/{name}" for name in ("acting", "settings", "commands")]

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    for name in ("sphinx", "furo", "myst_parser"):
        pytest.importorskip(name, reason=f"no {name}: make docs installs it")
    out = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-q", "-W", "--keep-going", "-E"]
    command += ["-c", str(ROOT / "docs/site"), "-d", str(out / "doctrees")]
    command += [str(ROOT), str(out / "html")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}  # the same Headway as here
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    return out / "html"


def text_of(page: Path) -> str:
    return re.sub(r"\s+", " ", html.unescape(re.sub(r"<[^>]+>", "", page.read_text())))


def test_nothing_is_loaded_from_elsewhere(site):
    pages = list(site.rglob("*.html"))
    assert len(pages) > 30
    for page in pages:
        assert LOADED.findall(page.read_text()) == []


def test_annotations_settings_and_commands_can_be_read(site):
    reference = site / "docs/site/reference"
    assert "→ Float[ndarray, 'action']" in text_of(reference / "acting.html")
    assert "planner.horizon: int = 30" in text_of(reference / "settings.html")
    assert "--run-dir PATH" in text_of(reference / "commands.html")


def test_what_the_guides_name_leads_to_the_reference(site):
    guide = (site / "docs/methods.html").read_text()
    assert 'href="site/reference/settings.html#model.kind"' in guide
    assert 'href="site/reference/methods.html#headway.register_method"' in guide


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium: apt-get install chromium-headless-shell")
@pytest.mark.parametrize("width", [360, 1280])
def test_pages_fit_the_window_and_show_their_images(site, width):
    api = pytest.importorskip("playwright.sync_api", reason="no Playwright: pip install playwright")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        page = browser.new_page(viewport={"width": width, "height": 800})
        asked = []
        page.on("request", lambda request: asked.append(request.url))
        for name in PAGES:
            page.goto((site / f"{name}.html").as_uri())
            assert page.evaluate("document.documentElement.scrollWidth") <= width, name
            assert page.evaluate("[...document.images].every(image => image.naturalWidth > 0)")
        browser.close()
    assert [url for url in asked if not url.startswith(("file:", "data:"))] == []
