"""The page in a real browser, from a folder: it sorts, filters and plays, and believes no submitter."""

import json
import os
import re
import shutil
import socket
import subprocess
import sys
import time
import urllib.request

import numpy as np
import pytest
from playwright.sync_api import sync_playwright
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from test_verify import TASK, add, altered, network, zipped

from hipg_bench.errors import BoardError
from hipg_bench.evaluation import protocol, runner
from hipg_bench.leaderboard import films
from hipg_bench.leaderboard.board import Board
from hipg_bench.leaderboard.entry_view import read_board
from hipg_bench.leaderboard.playing import BoardEvaluation
from hipg_bench.leaderboard.salt import new_salt, read_salt
from hipg_bench.leaderboard.site import build
from hipg_bench.leaderboard.source import opened
from hipg_bench.leaderboard.verify import verify
from hipg_bench.rendering import gl

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
needs_browser = pytest.mark.skipif(BROWSER is None, reason="no Chromium on this machine")
EVALUATION = BoardEvaluation((TASK,), ("standard", "forced_death"), episodes=6, threads=1)
EVIL = (
    "<script>window.pwned=1</script><img src=x onerror='window.pwned=2'>{{7*7}}{% raw %}"
    "</style><style>body{display:none}</style>\"'><svg onload=window.pwned=3>"
)
LINK = "https://example.org/\"onmouseover='window.pwned=4'<b>"


def hostile(folder):
    """A submission whose every word tries to run, to hide or to lead away."""
    network(folder, "hostile")
    words = {"summary": EVIL[:300], "authors": EVIL, "license": EVIL[:90], "link": LINK, "kind": "network"}
    card = "".join(f"{name} = {json.dumps(text)}\n" for name, text in {"name": "hostile", **words}.items())
    notes = "".join(f"{name} = {json.dumps(EVIL)}\n" for name in ("framework", "hardware", "notes"))
    (folder / "agent.toml").write_text(f"{card}[training]\n{notes}")
    (folder / "README.md").write_text(
        f"{EVIL}\n[here](javascript:window.pwned=5) ![x](https://example.org/x.png)\n"
    )
    return folder


def with_seeds(folder, count):
    """A method: weights that differ a little, as if they had been trained several times."""
    first = folder / TASK / "seed0.safetensors"
    with safe_open(first, "numpy") as file:
        metadata = file.metadata()
    for seed in range(1, count):
        tensors = {name: tensor * np.float32(1 + 0.01 * seed) for name, tensor in load_file(first).items()}
        save_file(tensors, folder / TASK / f"seed{seed}.safetensors", metadata)
    return folder


@pytest.fixture(scope="module")
def board(tmp_path_factory):
    """A verified checkpoint, a method, a hostile entry with hostile claims, and two references."""
    place = tmp_path_factory.mktemp("page")
    board = Board(place / "board")
    new_salt(board.root, place / "salt", "hipg-1")
    filmed = (TASK,) if gl.working_backend() else ()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(films, "_SIZE", (160, 90))
        patch.setattr(films, "_FPS", 5)
        add(board, network(place / "newcomer"), EVALUATION, film_tasks=filmed)
    add(board, with_seeds(network(place / "steady", "steady"), 5), EVALUATION)
    if (board.folder("newcomer") / "films").exists():
        # the same weights in the same world: the same film
        shutil.copytree(board.folder("newcomer") / "films", board.folder("steady") / "films")
    add(board, "scripted", EVALUATION)
    add(board, "zero", EVALUATION)
    package = zipped(hostile(place / "hostile"))
    with opened(package) as source:
        runner.evaluate(
            source.agent, EVALUATION.suite(), place / "claims" / "standard", EVALUATION.job("standard")
        )
    claims = altered(place / "claims", place / "evil", lambda row: row.update(end_reason=EVIL[:100]))
    add(board, package, BoardEvaluation((TASK,), ("standard",), episodes=6, threads=1), claims=claims)
    salt = read_salt(board.root, place / "salt")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol, "differences", list)
        assert verify(board, "newcomer", salt, place / "private", threads=1).outcome == "verified"
        assert verify(board, "hostile", salt, place / "private", threads=1).outcome == "mismatch"
    return board


@pytest.fixture(scope="module")
def site(board, tmp_path_factory):
    out = tmp_path_factory.mktemp("built") / "site"
    assert len(build(board, out).entries) == 5
    return out


@pytest.fixture(scope="module")
def browser():
    if BROWSER is None:
        pytest.skip("no Chromium on this machine")
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=BROWSER, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def visit(browser, site):
    """Open a page of the site; at the end, nothing may have gone wrong on it or left the folder."""
    contexts, trouble = [], []

    def open_page(path="index.html", **options):
        context = browser.new_context(**{"viewport": {"width": 1280, "height": 900}, **options})
        contexts.append(context)
        page = context.new_page()
        page.on(
            "console", lambda message: message.type in ("error", "warning") and trouble.append(message.text)
        )
        page.on("pageerror", lambda error: trouble.append(str(error)))
        page.on("dialog", lambda dialog: trouble.append(dialog.message))
        page.on(
            "request",
            lambda request: request.url.startswith((site.as_uri(), "data:")) or trouble.append(request.url),
        )
        page.goto((site / path).as_uri())
        return page

    yield open_page
    for context in contexts:
        context.close()
    assert trouble == []


def pages(site):
    return sorted(path.relative_to(site).as_posix() for path in site.rglob("*.html"))


def column(page, attribute):
    """A data attribute of the seen rows, in the order in which they stand."""
    rows = page.locator("#table .panel:not([hidden]) tbody tr:visible")
    return rows.evaluate_all(f"rows => rows.map(row => row.dataset.{attribute})")


def until(page, holds):
    """Wait for something; the page's policy forbids the driver's own way, which is `eval`."""
    deadline = time.monotonic() + 30
    while not holds():
        assert time.monotonic() < deadline
        page.wait_for_timeout(50)


@needs_browser
def test_numbers_are_those_of_the_rows(visit, board):
    page = visit()
    page.locator("select[name=family]").select_option("hazard_nav")
    entries = {one.name: one for one in read_board(board)}
    rows = entries["steady"].rows("public", "standard", TASK)
    runs = [np.mean([row["score"] for row in rows if row["train_seed"] == seed]) for seed in range(5)]
    # the family has three tasks, two of them not played: ten zeros of fifteen runs; three go at each end
    expected = np.sort([*runs, *[0.0] * 10])[3:-3].mean()
    row = page.locator("#table .panel:not([hidden]) tr[data-name=steady]")
    assert row.locator("td b").inner_text() == f"{expected:.2f}"
    assert float(row.get_attribute("data-score")) == pytest.approx(expected, abs=1e-9)
    # of hidden worlds three digits are published; a third of what its result says of the only task
    hidden = entries["newcomer"].task("standard", TASK)["score"]
    row = page.locator("#table .panel:not([hidden]) tr[data-name=newcomer]")
    assert float(row.get_attribute("data-score")) == pytest.approx(hidden / 3, rel=0.01)


@needs_browser
def test_sorting_by_mouse_and_keyboard(visit):
    page = visit()
    page.locator("select[name=status]").select_option("self-reported")
    for key, descends in (("survival", True), ("name", False), ("deaths", False)):
        head = page.locator(f"#table .panel:not([hidden]) table:visible button[data-sort={key}]")
        values = {"name": str}.get(key, float)
        head.click()
        found = [values(value) for value in column(page, key)]
        assert len(found) == 3
        assert found == sorted(found, reverse=descends)
        assert head.locator("xpath=..").get_attribute("aria-sort") == (
            "descending" if descends else "ascending"
        )
        # the same from the keyboard turns the order
        head.focus()
        page.keyboard.press("Enter")
        again = [values(value) for value in column(page, key)]
        assert again == sorted(found, reverse=not descends)
        assert again != found


@needs_browser
def test_filtering(visit):
    page = visit()
    everybody = {"newcomer", "steady", "scripted", "zero", "hostile"}
    assert set(column(page, "name")) == everybody
    # verified ones stand in a table of their own, above
    assert column(page, "name")[0] == "newcomer"
    for name, value, left in (
        ("status", "verified", {"newcomer"}),
        ("kind", "method", {"steady"}),
        ("kind", "reference", {"scripted", "zero"}),
        ("tier", "0", {"newcomer", "steady", "hostile"}),
        ("execution", "centralised", {"scripted"}),
    ):
        page.locator(f"select[name={name}]").select_option(value)
        assert set(column(page, "name")) == left
        page.locator(f"select[name={name}]").select_option("")
    page.locator("input[name=name]").fill("STEA")
    assert column(page, "name") == ["steady"]
    page.locator("input[name=name]").fill("nobody")
    assert page.locator("#none").is_visible()
    page.locator("input[name=name]").fill("")
    # another split is another table; who did not play it is not in it
    page.locator("label", has_text="Forced death").click()
    assert set(column(page, "name")) == everybody - {"hostile"}
    assert page.locator("h2", has_text="Scores by task").filter(has_text="Forced death").is_visible()


@needs_browser
def test_films_play_in_step(visit, site):
    if not list(site.glob("data/*/films/*.mp4")):
        pytest.skip("no OpenGL here, so no films")
    page = visit(f"tasks/{TASK}.html")
    assert page.locator(".films video").count() == 2
    assert page.locator("#play-all").inner_text() == "Play all"
    page.locator("#play-all").click()
    times = "[...document.querySelectorAll('.films video')].map(film => film.currentTime)"
    until(page, lambda: min(page.evaluate(times)) > 0.5)
    assert page.locator("#play-all").inner_text() == "Pause all"
    page.locator("#play-all").click()
    until(page, lambda: page.locator("#play-all").inner_text() == "Play all")
    stopped = page.evaluate(times)
    assert max(stopped) - min(stopped) < 0.5
    page.wait_for_timeout(300)
    assert page.evaluate(times) == stopped
    page.locator("#restart").click()
    until(page, lambda: max(page.evaluate(times)) == 0)


@needs_browser
def test_a_card_opens_from_the_table(visit):
    page = visit()
    page.locator("#table").get_by_role("link", name="newcomer").first.click()
    assert page.locator("h1").inner_text() == "newcomer"
    assert page.locator(".readme h2").inner_text().strip() == "A newcomer"
    assert page.locator(".badge").first.inner_text() == "✓ verified"
    assert page.locator("dt", has_text="rows compared").locator("+ dd").inner_text().startswith("12,")
    with page.expect_download() as got:
        page.locator(".files a").first.click()
    assert got.value.suggested_filename.endswith(".jsonl.gz")
    page.locator("table a", has_text=TASK).click()
    assert page.locator("h1").inner_text() == TASK


@needs_browser
def test_what_a_submitter_wrote_is_text(visit, site):
    for path in pages(site):
        page = visit(path)
        assert page.locator("script").count() == 2
        assert page.locator("img").count() == 0
        assert page.locator("style").count() == 1
        assert page.locator("body").is_visible()
        assert page.evaluate("window.pwned") is None
        for link in page.locator("a").evaluate_all("links => links.map(link => [link.href, link.rel])"):
            outside = ("https://example.org/", "https://github.com/instadeepai/marl-eval")
            assert link[0].startswith((site.as_uri(), *outside))
            assert link[0].startswith("file:") or "noopener" in link[1]
    page = visit("agents/hostile.html")
    assert page.locator(".lead").inner_text() == EVIL[:300]
    assert EVIL in page.locator(".readme").inner_text()
    assert "{{7*7}}" in page.locator("main").inner_text()
    assert "mismatch" in page.locator(".chips").inner_text()
    page.locator("details summary").click()
    # the claimed reason for the end, as text, in what differs and in the task's table
    assert "<script>" in page.locator("details li").inner_text()
    assert "<script>window.pwned" in visit(f"tasks/{TASK}.html").locator("main").inner_text()


@needs_browser
def test_the_policy_stops_what_escaping_might_miss(browser, site):
    page = browser.new_page()
    page.goto((site / "index.html").as_uri())
    refused = []
    page.on("console", lambda message: refused.append(message.text))
    page.evaluate(
        'const image = \'<img src="data:," onerror="window.pwned=1">\';'
        "const script = Object.assign(document.createElement('script'), {textContent: 'window.pwned=2'});"
        "document.body.insertAdjacentHTML('beforeend', image); document.body.append(script);"
    )
    page.evaluate("fetch('https://example.org/').catch(() => {})")
    page.wait_for_timeout(200)
    assert page.evaluate("window.pwned") is None
    assert sum("Content Security Policy" in text for text in refused) >= 3
    page.close()


@needs_browser
def test_a_phone_scrolls_down_only(visit, site):
    for path in pages(site):
        page = visit(path, viewport={"width": 390, "height": 844}, device_scale_factor=2, is_mobile=True)
        assert page.evaluate("document.documentElement.scrollWidth") == 390, path
    page = visit(viewport={"width": 390, "height": 844})
    row = page.locator("#table tr[data-name=newcomer]:visible")
    assert row.locator("td b").is_visible()
    assert row.locator(".phone").is_visible()


@needs_browser
def test_dark_and_light(visit):
    def lightness(page):
        colour = page.evaluate("getComputedStyle(document.body).backgroundColor")
        return sum(map(int, re.findall(r"\d+", colour)[:3])) / 3

    dark, light = visit(color_scheme="dark"), visit(color_scheme="light")
    assert lightness(dark) < 60 < 200 < lightness(light)
    light.locator("#theme").click()
    assert lightness(light) < 60
    # the choice holds on the next page
    light.locator("#table").get_by_role("link", name="steady").first.click()
    light.wait_for_load_state()
    assert light.locator("h1").inner_text() == "steady"
    assert lightness(light) < 60
    light.locator("#theme").click()
    assert lightness(light) > 200


def test_the_same_board_is_the_same_site(board, site, tmp_path):
    build(board, tmp_path / "site")
    build(board, tmp_path / "site")
    first, second = (
        {path.relative_to(root): path.read_bytes() for path in root.rglob("*") if path.is_file()}
        for root in (site, tmp_path / "site")
    )
    assert first == second
    assert list(tmp_path.iterdir()) == [tmp_path / "site"]


def test_the_data_for_programs_are_the_rows(board, site):
    entries = {one.name: one for one in read_board(board)}
    found = json.loads((site / "data" / "marl_eval_standard.json").read_text())["hipg_bench"][TASK]
    assert set(found) == set(entries)
    for name in ("newcomer", "zero"):
        values = found[name]["seed_0"]["absolute_metrics"]["return"]
        assert values == [row["return"] for row in entries[name].rows("public", "standard", TASK)]
    lines = json.loads((site / "data" / "board.json").read_text())
    (line,) = (
        one for one in lines if (one["split"], one["family"], one["name"]) == ("standard", "all", "steady")
    )
    assert (line["kind"], line["worlds"], line["rank"], line["tasks_played"]) == ("method", "public", 1, 1)


def test_a_film_is_kept_while_its_episodes_are_the_same(board, tmp_path):
    shutil.copytree(board.root, tmp_path / "board")
    again = Board(tmp_path / "board")
    (again.folder("zero") / "films").mkdir()
    (again.folder("zero") / "films" / f"{TASK}.mp4").write_bytes(b"a film")
    add(again, "zero", EVALUATION, replace=True)
    assert (again.folder("zero") / "films" / f"{TASK}.mp4").read_bytes() == b"a film"
    # other worlds: it is not theirs
    add(again, "zero", BoardEvaluation((TASK,), ("standard",), episodes=4, threads=1), replace=True)
    assert not (again.folder("zero") / "films").exists()


def test_a_folder_with_something_else_is_not_replaced(board, tmp_path):
    (tmp_path / "thesis.tex").write_text("")
    with pytest.raises(BoardError, match="holds something else"):
        build(board, tmp_path)
    with pytest.raises(BoardError, match="has no entries"):
        build(Board(tmp_path / "empty"), tmp_path / "site")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["thesis.tex"]


def test_serving_is_for_this_machine_only(board):
    main = "from hipg_bench.cli import main; main()"
    command = [sys.executable, "-uc", main, "leaderboard", "serve", "--port", "0", "--board", str(board.root)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as server:
        try:
            port = int(re.match(r"http://127\.0\.0\.1:(\d+)/", server.stdout.readline())[1])
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/agents/newcomer.html", timeout=10) as page:
                assert b"newcomer" in page.read()
            with pytest.raises(ConnectionRefusedError):
                # another address of this machine, as a neighbour would use
                socket.create_connection(("127.0.0.2", port), timeout=5).close()
        finally:
            server.kill()


def test_a_damaged_entry_is_left_out_and_named(board, tmp_path):
    shutil.copytree(board.root, tmp_path / "board")
    folder = tmp_path / "board" / "entries" / "steady" / "standard"
    (folder / "results.json").write_text("{}")
    view = build(Board(tmp_path / "board"), tmp_path / "site")
    assert len(view.entries) == 4
    assert list(view.left_out) == ["steady"]
    front = (tmp_path / "site" / "index.html").read_text()
    assert "Left out, because their files are damaged: steady." in front
    assert "newcomer" in front


def test_files_that_somebody_added_to_a_site_stay(board, tmp_path):
    site = tmp_path / "site"
    build(board, site)
    (site / "CNAME").write_text("bench.example.org")
    (site / ".git").mkdir()
    (site / ".git" / "config").write_text("mine")
    build(board, site)
    assert (site / "CNAME").read_text() == "bench.example.org"
    assert (site / ".git" / "config").read_text() == "mine"
    assert (site / "index.html").exists()


def contents(folder):
    """Every path in a folder, with the bytes of files and the targets of links."""
    return {
        path.relative_to(folder): os.readlink(path)
        if path.is_symlink()
        else path.is_file() and path.read_bytes()
        for path in folder.rglob("*")
    }


def test_empty_folders_and_links_of_others_stay(board, tmp_path):
    real, site = tmp_path / "real", tmp_path / "site"
    site.symlink_to(real)
    real.mkdir()
    build(board, site)
    (real / ".git" / "refs" / "tags").mkdir(parents=True)
    (real / "mine").symlink_to("nowhere")
    (real / "agents" / "notes.txt").write_text("mine")
    made = contents(real)
    build(board, site)
    assert site.is_symlink()
    assert contents(real) == made


@pytest.mark.parametrize(
    "mark", [b"\xff\xfe", b"", b"somebody's\n", b"made by hipg-bench leaderboard build\n../x\n"]
)
def test_a_damaged_mark_of_a_site_loses_no_file(board, tmp_path, mark):
    site = tmp_path / "site"
    build(board, site)
    (tmp_path / "x").write_text("mine")
    (site / "CNAME").write_text("mine")
    (site / "hipg-bench-site").write_bytes(mark)
    before = contents(tmp_path)
    with pytest.raises(BoardError):
        build(board, site)
    assert contents(tmp_path) == before


def test_pages_of_entries_that_are_gone_go_and_files_of_others_are_not_overwritten(board, tmp_path):
    shutil.copytree(board.root, tmp_path / "board")
    own, site = Board(tmp_path / "board"), tmp_path / "site"
    build(own, site)
    shutil.rmtree(own.root / "entries" / "steady")
    build(own, site)
    assert not (site / "agents" / "steady.html").exists()
    assert not (site / "data" / "steady" / "entry.json").exists()
    (site / "agents" / "steady.html").write_text("mine")
    before = contents(site)
    with pytest.raises(BoardError, match=r"steady\.html is not of an earlier build"):
        build(board, site)
    assert contents(site) == before


@pytest.mark.parametrize(
    "curve", ["steps,return\n1,2\n", "steps,return\n1,1e308\n2,-1e308\n", "steps,return\n5,1\n1,2\n"]
)
def test_an_odd_learning_curve_breaks_no_page(tmp_path, curve):
    folder = network(tmp_path / "odd", "odd")
    (folder / TASK / "seed0.curve.csv").write_text(curve)
    own = Board(tmp_path / "board")
    add(own, folder, BoardEvaluation((TASK,), ("standard",), episodes=3, threads=1))
    assert len(build(own, tmp_path / "site").entries) == 1
    page = (tmp_path / "site/agents/odd.html").read_text()
    assert not re.search(r'[ "]nan[ ",]', page.lower())
