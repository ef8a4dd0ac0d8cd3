"""Hooks of mkdocs: task pages in the navigation, figures that take the page's colours, llms.txt."""

import re
import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

ROOT = Path(__file__).parents[2]
_FIGURE = re.compile(r'<img alt="([^"]*)" src="([^"]+\.svg)"\s*/?>')


def on_config(config: Any) -> Any:
    """List every task of the benchmark in the navigation."""
    names = sorted(path.stem for path in (ROOT / "tasks").glob("*.toml"))
    (section,) = [entry["Tasks"] for entry in config.nav if isinstance(entry, dict) and "Tasks" in entry]
    section[1:1] = [f"tasks/{name}.md" for name in names if f"tasks/{name}.md" not in section]
    return config


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Lead links to notebooks to the pages made of them; in the repository they lead to the notebooks."""
    return re.sub(r"(notebooks/\w+)\.ipynb\)", r"\1.md)", markdown)


def on_page_content(html: str, page: Any, config: Any, files: Any) -> str:
    """Put SVG figures into the page itself, where they take its text colour."""
    folder = Path(page.file.abs_src_path).parent if page.file.abs_src_path else None

    def inline(found: re.Match[str]) -> str:
        name = Path(found[2]).name
        places = list((ROOT / "docs").rglob(name)) if folder else []
        return places[0].read_text(encoding="utf-8") if places else found[0]

    return _FIGURE.sub(inline, html)


def on_post_build(config: Any) -> None:
    """Write llms.txt: what there is to read, for programs that read."""
    import llms

    llms.write(Path(config.site_dir), config.nav)
