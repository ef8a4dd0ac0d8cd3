"""The documentation site: it builds without a warning, and a browser finds its way on it."""

import functools
import os
import re
import shutil
import subprocess
import sys
import threading
from collections.abc import Iterator
from html.parser import HTMLParser
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from playwright.sync_api import sync_playwright

from hipg_bench.registry import tasks

pytest.importorskip("mkdocs", reason="the packages of the site are not installed: scripts/setup.sh --docs")
ROOT = Path(__file__).parent.parent
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Path:
    """The site, built once; strict, so that a warning (such as a dead link in Markdown) is an error."""
    out = tmp_path_factory.mktemp("site") / "built"
    done = subprocess.run(
        [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(out)],
        cwd=ROOT, capture_output=True, text=True, check=False, timeout=300,
        env={**os.environ, "NO_MKDOCS_2_WARNING": "1", "DISABLE_MKDOCS_2_WARNING": "true"},
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return out


class Links(HTMLParser):
    """What a page links to and loads, and the places in it that can be linked to."""

    def __init__(self, page: Path) -> None:
        super().__init__()
        self.targets: list[str] = []
        self.ids: set[str] = set()
        self.feed(page.read_text(encoding="utf-8"))

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name in ("id", "name") and value:
                self.ids.add(value)
            if value and ((name == "href" and tag in ("a", "link")) or (name == "src")):
                self.targets.append(value)


def pages(site: Path) -> list[Path]:
    return [path for path in sorted(site.rglob("*.html")) if path.name != "404.html"]


def test_every_internal_link_resolves(site):
    parsed = {path: Links(path) for path in pages(site)}
    dead = []
    for path, links in parsed.items():
        for target in links.targets:
            url = urlsplit(target)
            if url.scheme or target.startswith("data:"):
                continue
            other = (path.parent / unquote(url.path)).resolve() if url.path else path
            if not other.is_file():
                dead.append((path.name, target))
            elif url.fragment and other in parsed and unquote(url.fragment) not in parsed[other].ids:
                # "__..." are the theme's own, made by its script
                dead += [(path.name, target)] if not url.fragment.startswith("__") else []
    assert len(parsed) > 40
    assert dead == []


def test_every_task_has_a_page_with_its_numbers(site):
    for spec in tasks().values():
        text = (site / "tasks" / f"{spec.task}.html").read_text(encoding="utf-8")
        for name in (*spec.params, *spec.weights):
            assert f"<code>{name}</code>" in text
        assert spec.fingerprint in text
        assert f'href="tasks/{spec.task}.html"' in (site / "index.html").read_text(encoding="utf-8")


def test_scores_and_blocks_on_a_task_page_are_those_of_their_sources(site):
    """hazard_nav-4: its 51 numbers as in the family's layout, its scores as in the leaderboard's results."""
    text = re.sub(r"<[^>]+>", " ", (site / "tasks" / "hazard_nav-4.html").read_text(encoding="utf-8"))
    text = " ".join(text.split())
    # own health, velocity 3, position 3, 4 points x (3 + 1 + 1), 3 neighbours x (1 + 1 + 3 + 3)
    assert "51 numbers" in text
    assert "neighbor_velocity 42 to 50 3 x 3 m/s own" in text
    # leaderboard/entries/mappo_minhealth/standard/results.json: 0.8009, 0.8125
    assert re.search(r"mappo_minhealth 0\.80 \[0\.79, 0\.82\] .* 81%", text)
    assert "Hazard. A few points lie in a hazard" in text


def test_every_public_name_is_in_the_reference(site):
    import hipg_bench

    text = (site / "reference" / "api.html").read_text(encoding="utf-8")
    assert [name for name in hipg_bench.__all__ if f'id="hipg_bench.{name}"' not in text] == []


def test_every_command_is_in_the_reference(site):
    from typer.main import get_command

    from hipg_bench.cli import app

    text = (site / "reference" / "command_line.html").read_text(encoding="utf-8")
    assert [name for name in get_command(app).commands if f">hipg-bench {name}<" not in text] == []


def test_llms_txt_lists_every_page(site):
    listed = set(re.findall(r"\]\((\S+\.html)\)", (site / "llms.txt").read_text(encoding="utf-8")))
    assert listed == {path.relative_to(site).as_posix() for path in pages(site)}


# --- in a browser --------------------------------------------------------------------------------------


class Quiet(SimpleHTTPRequestHandler):
    def log_message(self, *_args):
        pass


@pytest.fixture(scope="module")
def address(site) -> Iterator[str]:
    """The site on this machine's loopback: the search of the theme needs a server."""
    server = ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=site))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield f"http://127.0.0.1:{server.server_port}/"
    server.shutdown()


@pytest.fixture(scope="module")
def browser():
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield browser
        browser.close()


def visitor(browser, address, **options):
    """A page, and the list of what goes wrong on it; requests to elsewhere are refused and listed."""
    page, trouble = browser.new_page(**options), []
    page.on("console", lambda message: message.type in ("error", "warning") and trouble.append(message.text))
    page.on("pageerror", lambda error: trouble.append(str(error)))

    def only_here(route):
        if route.request.url.startswith(address):
            route.continue_()
        else:
            trouble.append(route.request.url)
            route.abort()

    page.route("**/*", only_here)
    return page, trouble


@needs_browser
@pytest.mark.parametrize("width", [390, 1300])
def test_no_page_is_wider_than_the_window_or_writes_an_error(browser, address, site, width):
    page, trouble = visitor(browser, address, viewport={"width": width, "height": 900})
    names = [path.relative_to(site).as_posix() for path in pages(site)]
    wide = []
    # on a wide window one page of each kind is enough
    for name in names if width == 390 else sorted({name.partition("/")[0]: name for name in names}.values()):
        page.goto(address + name, wait_until="domcontentloaded")
        if page.evaluate("document.documentElement.scrollWidth") > width:
            wide.append(name)
    page.close()
    assert wide == []
    assert trouble == []


@needs_browser
@pytest.mark.parametrize(("scheme", "dark"), [("light", False), ("dark", True)])
def test_the_site_follows_the_colour_scheme_and_pictures_stay_legible(browser, address, scheme, dark):
    page, trouble = visitor(browser, address, color_scheme=scheme)
    page.goto(address + "concepts/health.html")

    def lightness(colour):
        red, green, blue = map(float, re.findall(r"[\d.]+", colour)[:3])
        return (red + green + blue) / 3

    ground = lightness(page.evaluate("getComputedStyle(document.body).backgroundColor"))
    label = "document.querySelector('svg.figure text')"
    ink = lightness(page.evaluate(f"getComputedStyle({label}).fill"))
    page.close()
    assert (ground < 60) if dark else (ground > 200)
    assert (ink > 150) if dark else (ink < 100)
    assert trouble == []


@needs_browser
def test_search_finds_a_page(browser, address):
    page, trouble = visitor(browser, address, viewport={"width": 1300, "height": 900})
    page.goto(address)
    page.locator("input.md-search__input").click()
    page.locator("input.md-search__input").press_sequentially("cumulative hazard")
    result = page.locator(".md-search-result__link").first
    result.wait_for(timeout=20_000)
    results = page.locator(".md-search-result__link").evaluate_all("links => links.map(link => link.href)")
    page.close()
    assert any("/concepts/health.html" in link for link in results)
    assert trouble == []
