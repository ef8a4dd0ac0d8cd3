"""An entry as the page shows it: its card, its results on each split, its rows where a chart needs them."""

from __future__ import annotations

import csv
import dataclasses
import functools
import hashlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

from hipg_bench.documents import read_json
from hipg_bench.errors import BoardError
from hipg_bench.evaluation.ranking import Kind, kind_of
from hipg_bench.evaluation.splits import SPLITS
from hipg_bench.leaderboard.board import Board
from hipg_bench.leaderboard.entry import Entry, Status, read_entry
from hipg_bench.leaderboard.rows import parse_rows, unpack
from hipg_bench.leaderboard.salt import read_commitments
from hipg_bench.policies.card import Card, read_card

Worlds = Literal["hidden", "public"]
WORLDS: tuple[Worlds, ...] = ("hidden", "public")


@dataclasses.dataclass(frozen=True)
class EntryView:
    """An entry, read.

    Attributes:
        entry: what the board says of it.
        card: what it says of itself.
        readme: its model card, plain text.
        folder: its folder on the board.
        status: its badge.
        results: (worlds, split) to ``results.json``.
    """

    entry: Entry
    card: Card
    readme: str
    folder: Path
    status: Status
    results: Mapping[tuple[Worlds, str], Mapping[str, Any]]

    @property
    def name(self) -> str:
        """Its name."""
        return self.entry.name

    @property
    def worlds(self) -> Worlds:
        """The worlds whose scores count: hidden ones once verified there."""
        return "hidden" if self.status == "verified" else "public"

    @property
    def kind(self) -> Kind:
        """What it is, for its rank."""
        return kind_of(self.card.kind == "builtin", [len(seeds) for seeds in self.entry.policies.values()])

    def result(self, split: str) -> Mapping[str, Any] | None:
        """Results on a split in the worlds that count; None if it was not played."""
        return self.results.get((self.worlds, split))

    def task(self, split: str, task: str) -> Mapping[str, Any] | None:
        """The same of one task."""
        result = self.result(split)
        return next((one for one in result["tasks"] if one["task"] == task), None) if result else None

    @functools.cached_property
    def curves(self) -> Mapping[str, Mapping[int, list[tuple[float, float]]]]:
        """Task to training seed to (environment steps, return) while learning."""
        found: dict[str, dict[int, list[tuple[float, float]]]] = {}
        for path in sorted(self.folder.glob("curves/*/seed*.csv")):
            with path.open(encoding="utf-8", newline="") as lines:
                points = [(float(row["steps"]), float(row["return"])) for row in csv.DictReader(lines)]
            found.setdefault(path.parent.name, {})[int(path.stem.removeprefix("seed"))] = points
        return found

    @property
    def films(self) -> dict[str, Path]:
        """Task to film."""
        return {path.stem: path for path in sorted(self.folder.glob("films/*.mp4"))}

    def has(self, path: str) -> bool:
        """Whether a file of rows is there: those of hidden worlds come when the salt is revealed."""
        return (self.folder / path).is_file()

    def text(self, worlds: Worlds, split: str, task: str) -> bytes:
        """The raw rows, a line each.

        Raises:
            BoardError: they are damaged, or not those that were entered.
        """
        path = rows_path(worlds, split, task)
        text = unpack(self.folder / path)
        if hashlib.sha256(text).hexdigest() != self.entry.rows.get(path):
            raise BoardError(
                f"{self.folder / path} is not what was entered: its hash differs from entry.json's"
            )
        return text

    def rows(self, worlds: Worlds, split: str, task: str) -> list[dict[str, Any]]:
        """The same, parsed."""
        return parse_rows(self.text(worlds, split, task), f"{self.name}: {split}/{task}")


def run_path(worlds: Worlds, split: str) -> str:
    """Where results on a split lie in an entry's folder."""
    return split if worlds == "public" else f"hidden/{split}"


def rows_path(worlds: Worlds, split: str, task: str) -> str:
    """Where rows lie in an entry's folder."""
    return f"{run_path(worlds, split)}/episodes/{task}.jsonl.gz"


def read_board(board: Board) -> list[EntryView]:
    """Read all entries, in the order of their names.

    Raises:
        HipgError: an entry is damaged.
    """
    commitment = read_commitments(board.root).sha256
    return [read_entry_view(board.folder(name), commitment) for name in board.names()]


def read_entry_view(folder: Path, commitment: str | None) -> EntryView:
    """Read an entry's folder, while ``commitment`` is that of the board's hidden worlds.

    Raises:
        HipgError: it is damaged.
    """
    entry = read_entry(folder)
    readme = folder / "README.md"
    results: dict[tuple[Worlds, str], Any] = {
        (worlds, split): read_json(path)
        for worlds in WORLDS
        for split in SPLITS
        if (path := folder / run_path(worlds, split) / "results.json").is_file()
    }
    return EntryView(
        entry,
        read_card(folder / "agent.toml"),
        readme.read_text(encoding="utf-8", errors="replace") if readme.is_file() else "",
        folder,
        entry.status(commitment),
        results,
    )
