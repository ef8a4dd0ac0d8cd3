"""`build`: the board as a static site, which opens from a folder without server or network.

    index.html               the tables, how sure they are, and what everything means
    tasks/<task>.html        one task: films side by side, learning curves, scores
    agents/<name>.html       one entry: its model card, who checked it, its numbers and rows
    data/                    the same for programs

Everything a submitter wrote passes through the templates' escaping; the pages allow no script but their
own, by its hash.
"""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import jinja2
import markupsafe

from hipg_bench import registry
from hipg_bench.errors import BoardError, BundleError, HipgError
from hipg_bench.evaluation import export, splits
from hipg_bench.evaluation.words import end_reason
from hipg_bench.leaderboard import pictures, standings
from hipg_bench.leaderboard.board import Board
from hipg_bench.leaderboard.entry_view import EntryView, read_entry_view
from hipg_bench.leaderboard.model_card import to_html
from hipg_bench.leaderboard.salt import Commitments, read_commitments
from hipg_bench.paths import PARTIAL, write_text
from hipg_bench.policies.card import check_regular
from hipg_bench.rendering import film
from hipg_bench.spec import TaskSpec

_TEMPLATES = Path(__file__).parent / "templates"
_MARK = "hipg-bench-site"
"""A file that tells a site of ours from a folder that must not be replaced, and lists what is ours in it."""
_MADE = "made by hipg-bench leaderboard build"
SPLIT_NAMES = {
    "standard": "Standard",
    "shift": "Shifted physics",
    "forced_death": "Forced death",
    "ad_hoc": "Ad-hoc team",
}
STATUS_SAYS = {
    "verified": "A maintainer ran it again, apart from everything else: its rows came out byte for byte, "
    "and the scores are those of hidden worlds.",
    "self-reported": "The rows are on public worlds, and nobody has checked them on hidden ones yet.",
    "mismatch": "Run again, rows came out otherwise than claimed.",
    "unsandboxed": "It was run by somebody who trusted it, without a sandbox: it could have cheated.",
    "outdated": "It was verified on hidden worlds that have since been revealed.",
}


@dataclasses.dataclass(frozen=True)
class View:
    """What all pages draw from."""

    entries: Sequence[EntryView]
    specs: Sequence[TaskSpec]
    panels: Sequence[standings.Panel]
    commitments: Commitments
    left_out: Mapping[str, str]

    @property
    def played(self) -> list[str]:
        """The splits that there are tables of."""
        return list(dict.fromkeys(panel.split for panel in self.panels))

    @property
    def drawn(self) -> list[EntryView]:
        """The entries that charts show: the best ones, and the references."""
        return pictures.drawn(self.panels[0]) if self.panels else []


def build(board: Board, out: Path) -> View:
    """Write the site into a folder, over an earlier one; return what it shows.

    Damaged entries are left out, and the page says so. Files and folders that somebody added to an earlier
    site stay as they are: only files that an earlier build lists as its own are replaced or removed.

    Raises:
        BoardError: the folder holds something else, a file of somebody's would be overwritten, or the board
            has no entries that can be shown.
    """
    ours = _read_mark(out)
    specs = [registry.task_spec(task) for task in registry.tagged("standard")]
    entries, left_out = _entries(board, specs)
    if left_out and not entries:
        raise BoardError(f"no entry of {board.root} can be shown: {next(iter(left_out.values()))}")
    if not entries:
        raise BoardError(f"{board.root} has no entries: add one with `hipg-bench leaderboard add`")
    panels = standings.panels(entries, specs)
    view = View(entries, specs, panels, read_commitments(board.root), left_out)
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=PARTIAL, dir=out) as place:
        fresh = Path(place)
        _pages(view, fresh)
        _data(view, fresh / "data")
        _replace(out, ours, fresh)
    return view


def _entries(board: Board, specs: Sequence[TaskSpec]) -> tuple[list[EntryView], dict[str, str]]:
    """The entries that can be shown, and why the others cannot."""
    commitment = read_commitments(board.root).sha256
    entries, left_out = list[EntryView](), dict[str, str]()
    for name in board.names():
        try:
            one = read_entry_view(board.folder(name), commitment)
            # all that is computed of it, by itself: one entry's damage must not break the page of the others
            pictures.agent(one, specs)
            pictures.overview(standings.panels([one], specs), specs)
            for spec in specs:
                pictures.task([one], [one], spec)
        except (
            HipgError,
            OSError,
            LookupError,
            TypeError,
            ValueError,
            ArithmeticError,
            AttributeError,
        ) as error:
            left_out[name] = f"{name}: {type(error).__name__}: {error}"
        else:
            entries.append(one)
    return entries, left_out


def _read_mark(site: Path) -> set[str]:
    """The files of an earlier build in a folder, none if it is new or empty.

    Raises:
        BoardError: the folder is none of a site.
    """
    if not os.path.lexists(site):
        return set()
    if not site.is_dir():
        raise BoardError(f"{site} is no folder: choose another one for the site")
    mark = site / _MARK
    if not os.path.lexists(mark):
        if any(site.iterdir()):
            raise BoardError(f"{site} holds something else: choose an empty folder for the site")
        return set()
    try:
        check_regular(mark)
        made, *names = mark.read_text(encoding="utf-8").splitlines()
    except (BundleError, ValueError) as error:
        raise BoardError(f"{mark} is damaged, so files of others cannot be told: {error}") from error
    if made != _MADE or any(Path(name).is_absolute() or ".." in Path(name).parts for name in names):
        raise BoardError(f"{mark} is not of `hipg-bench leaderboard build`: choose another folder")
    return set(names)


def _replace(site: Path, ours: set[str], fresh: Path) -> None:
    """Move new files over those of an earlier build, and remove those that are no longer made.

    Raises:
        BoardError: somebody else's file is in the way; nothing is changed then.
    """
    names = sorted(path.relative_to(fresh).as_posix() for path in fresh.rglob("*") if path.is_file())
    for name in names:
        _refuse_in_the_way(site, name, ours)
    # whatever moment it is killed at, each file of ours is listed
    _write_mark(site, {*ours, *names})
    for name in names:
        (site / name).parent.mkdir(parents=True, exist_ok=True)
        (fresh / name).replace(site / name)
    for name in sorted(ours.difference(names)):
        path = site / name
        if path.is_file() and not _is_linked(site, name):
            path.unlink()
            with contextlib.suppress(OSError):  # not empty
                path.parent.rmdir()
    _write_mark(site, set(names))


def _refuse_in_the_way(site: Path, name: str, ours: set[str]) -> None:
    path = site / name
    if (os.path.lexists(path) and name not in ours) or path.is_dir() or _is_linked(site, name):
        raise BoardError(f"{path} is not of an earlier build and would be overwritten: move it away")
    for folder in path.relative_to(site).parents:
        if os.path.lexists(site / folder) and not (site / folder).is_dir():
            raise BoardError(f"{site / folder} is in the way of a folder of the site: move it away")


def _is_linked(site: Path, name: str) -> bool:
    """Whether a path leads over a link within the site."""
    path = site / name
    return any((site / folder).is_symlink() for folder in path.relative_to(site).parents[:-1])


def _write_mark(site: Path, names: set[str]) -> None:
    write_text(site / _MARK, "\n".join([_MADE, *sorted(names)]) + "\n")


def _pages(view: View, out: Path) -> None:
    environment = _environment()
    common: dict[str, Any] = {
        "view": view, "splits": splits.SPLITS, "split_names": SPLIT_NAMES, "status_says": STATUS_SAYS,
        "end_reason": end_reason,
        **_inline("style.css"), **_inline("theme.js"), **_inline("page.js"),
    }  # fmt: skip
    seen = pictures.overview(view.panels, view.specs)
    _write(environment, "index.html.j2", out / "index.html", common | seen)
    for spec in view.specs:
        seen = {"spec": spec} | pictures.task(view.entries, view.drawn, spec)
        _write(environment, "task.html.j2", out / "tasks" / f"{spec.task}.html", common | seen)
    for one in view.entries:
        seen = {"one": one} | pictures.agent(one, view.specs)
        _write(environment, "agent.html.j2", out / "agents" / f"{one.name}.html", common | seen)


def _write(environment: jinja2.Environment, template: str, path: Path, values: Mapping[str, Any]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    root = "" if path.name == "index.html" else "../"
    path.write_text(environment.get_template(template).render(root=root, **values), encoding="utf-8")


def _inline(name: str) -> dict[str, str]:
    """The page's own style or script, and its hash for the content security policy."""
    text = (_TEMPLATES / name).read_text(encoding="utf-8")
    digest = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    key = name.split(".")[0]
    return {key: text, f"{key}_hash": f"'sha256-{digest}'"}


def _environment() -> jinja2.Environment:
    """Templates with escaping on."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_TEMPLATES), autoescape=True, undefined=jinja2.StrictUndefined,
        trim_blocks=True, lstrip_blocks=True,
    )  # fmt: skip
    filters = cast(dict[str, Any], environment.filters)
    filters |= {
        "number": _number, "share": _share, "interval": _interval, "place": place, "breakable": _breakable,
        "markdown": to_html,
    }  # fmt: skip
    return environment


def place(score: float) -> float:
    """Where a score stands on the score axis, in percent; the axis runs from -0.25 to 1.25."""
    return round(100 * min(max((score + 0.25) / 1.5, 0.0), 1.0), 2)


def _number(value: float | None, digits: int = 2) -> str:
    """A number with a true minus sign, or a dash where it is not defined."""
    if value is None:
        return "\u2013"
    # no minus sign before a zero
    return f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "\u2212")


def _breakable(name: str) -> markupsafe.Markup:
    """A name that may continue on the next line after an underscore."""
    return markupsafe.Markup("_<wbr>").join(name.split("_"))


def _share(value: float | None) -> str:
    return "\u2013" if value is None else f"{100 * value:.0f} %"


def _interval(ends: Sequence[float] | None, digits: int = 2) -> str:
    return "" if ends is None else f"[{_number(ends[0], digits)}, {_number(ends[1], digits)}]"


def _data(view: View, out: Path) -> None:
    """Rows, results and films of every entry, and the board in one file."""
    for one in view.entries:
        for path in sorted(one.folder.rglob("*")):
            kept = path.suffix in (".gz", ".csv", ".mp4") or path.name in (
                "results.json",
                "entry.json",
                "agent.toml",
            )
            if kept and path.is_file():
                target = out / one.name / path.relative_to(one.folder)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
                if path.suffix == ".mp4":
                    film.write_poster(path, target.with_suffix(".jpg"))
    summary = [
        {
            "split": panel.split, "family": panel.family, "worlds": worlds, "rank": line.rank,
            "name": line.view.name, "status": line.view.status, "kind": line.view.kind,
            "score_iqm": line.score, "score_iqm_ci95": line.ci95, "survival": line.survival,
            "deaths": line.deaths, "tasks_played": line.played, "tasks": line.tasks, "dnf": line.dnf,
        }
        for panel in view.panels
        for worlds, lines in (("hidden", panel.verified), ("public", panel.reported))
        for line in lines
    ]  # fmt: skip
    out.mkdir(parents=True, exist_ok=True)
    (out / "board.json").write_text(json.dumps(summary, indent=1) + "\n", encoding="utf-8")
    for split in view.played:
        document = json.dumps(_marl_eval(view.entries, split)) + "\n"
        (out / f"marl_eval_{split}.json").write_text(document, encoding="utf-8")


def _marl_eval(entries: Sequence[EntryView], split: str) -> export.Document:
    """A split's episodes on public worlds in marl-eval's form: rows of hidden ones are not published."""
    with tempfile.TemporaryDirectory(prefix="hipg-export-") as place:
        folders: list[Path] = []
        for one in entries:
            result = one.results.get(("public", split))
            if result is not None:
                folder = Path(place) / one.name
                (folder / "episodes").mkdir(parents=True)
                (folder / "results.json").write_text(json.dumps(result), encoding="utf-8")
                for task in result["tasks"]:
                    rows = one.text("public", split, task["task"])
                    (folder / "episodes" / f"{task['task']}.jsonl").write_bytes(rows)
                folders.append(folder)
        return export.marl_eval(folders)
