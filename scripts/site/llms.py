"""``llms.txt``: the site's contents for programs that read, as https://llmstxt.org proposes."""

import re
from html.parser import HTMLParser
from pathlib import Path
from typing import Any


class _Description(HTMLParser):
    """Title and first paragraph of a page."""

    def __init__(self) -> None:
        super().__init__()
        self.inside, self.title, self.text, self._tag = False, "", "", ""

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "article":
            self.inside = True
        if self.inside and tag in ("h1", "p") and not (tag == "p" and self.text):
            self._tag = tag
        if tag == "a" and ("class", "headerlink") in attrs:
            self._tag = ""

    def handle_endtag(self, tag: str) -> None:
        if tag == self._tag:
            self._tag = ""

    def handle_data(self, data: str) -> None:
        if self._tag == "h1":
            self.title += data
        elif self._tag == "p":
            self.text += data


def write(site: Path, nav: list[Any]) -> None:
    """Write ``llms.txt`` into a built site, in the order of its navigation."""
    head = _describe(site / "index.html")
    lines = [f"# {head.title}", "", f"> {' '.join(head.text.split())}"]
    plain = [
        one for entry in nav for one in _pages(entry) if not isinstance(next(iter(entry.values())), list)
    ]
    lines += ["", *(_line(site, page) for page in plain)]
    for entry in nav:
        if isinstance(entry, dict) and isinstance(next(iter(entry.values())), list):
            lines += ["", f"## {next(iter(entry))}", "", *(_line(site, page) for page in _pages(entry))]
    (site / "llms.txt").write_text("\n".join(lines) + "\n", encoding="utf-8")


def _pages(entry: Any) -> list[str]:
    if isinstance(entry, str):
        return [entry]
    (value,) = entry.values()
    return [page for part in value for page in _pages(part)] if isinstance(value, list) else [value]


def _line(site: Path, page: str) -> str:
    html = re.sub(r"\.(md|ipynb)$", ".html", page)
    found = _describe(site / html)
    first = re.split(r"(?<=\.)\s", " ".join(found.text.split()))[0]
    return f"- [{found.title.strip()}]({html}): {first}"


def _describe(path: Path) -> _Description:
    parser = _Description()
    parser.feed(path.read_text(encoding="utf-8"))
    return parser
