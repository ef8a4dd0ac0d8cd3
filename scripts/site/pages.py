"""Pages of the site that are generated when it is built; run by mkdocs-gen-files.

A page per task and their list, the command line, the project's own documents, notebooks.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(Path(__file__).parent))

import command_page  # noqa: E402
import mkdocs_gen_files  # noqa: E402
import notebooks  # noqa: E402
import task_page  # noqa: E402
from tables import table  # noqa: E402

from hipg_bench.comparison.traces import traces  # noqa: E402
from hipg_bench.registry import tasks  # noqa: E402

DOCUMENTS = {
    "ARCHITECTURE.md": "project/architecture.md",
    "CONTRIBUTING.md": "project/contributing.md",
    "SECURITY.md": "project/security.md",
    "CHANGELOG.md": "project/changelog.md",
}
"""Documents of the repository to the pages that they are on the site."""
SUITES = {
    "standard": "The standard suite: what a score of the leaderboard is made of",
    "paper": "The paper's campaigns",
    "": "Others",
}


def write(path: str, text: str) -> None:
    """Add a page to the site."""
    with mkdocs_gen_files.open(path, "w", encoding="utf-8") as file:
        file.write(text)


def write_tasks() -> None:
    """A page per task, and the page that lists them."""
    runs = traces(ROOT / "agents")
    sections: dict[str, list[tuple[str, ...]]] = {suite: [] for suite in SUITES}
    for spec in tasks().values():
        write(f"tasks/{spec.task}.md", task_page.page(spec, runs))
        suite = next((tag for tag in SUITES if tag in spec.tags), "")
        sensitivity = spec.calibration.get("hazard_sensitivity")
        sections[suite].append((
            f"[{spec.task}]({spec.task}.md)",
            spec.summary,
            str(spec.num_agents),
            "-" if sensitivity is None else f"{sensitivity:.2f}",
        ))  # fmt: skip
    columns = ("task", "", ">agents", ">hazard sensitivity")
    lists = "\n".join(
        f"## {SUITES[suite]}\n\n{table(columns, rows)}" for suite, rows in sections.items() if rows
    )
    start = (ROOT / "docs" / "tasks" / "index.md").read_text(encoding="utf-8")
    write("tasks/index.md", f"{start}\n{lists}")


def write_documents() -> None:
    """The repository's own documents, with links that hold on the site."""
    for name, path in DOCUMENTS.items():
        text = (ROOT / name).read_text(encoding="utf-8")
        text = re.sub(r"\]\(docs/", "](../", text)
        for other, page in DOCUMENTS.items():
            text = text.replace(f"]({other})", f"](../{page})")
        write(path, text.replace("](README.md)", "](../index.md)"))


def write_notebooks() -> None:
    """Notebooks as pages, with the outputs that are stored in them."""
    for path in sorted(notebooks.FOLDER.glob("*.ipynb")):
        text, pictures = notebooks.page(path)
        write(f"notebooks/{path.stem}.md", text)
        for name, picture in pictures.items():
            with mkdocs_gen_files.open(f"notebooks/{name}", "wb") as file:
                file.write(picture)


write_tasks()
write_documents()
write_notebooks()
write("reference/command_line.md", command_page.page())
