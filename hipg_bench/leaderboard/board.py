"""The store: a folder per entry, each of which appears, changes and disappears whole.

    commitment.json         hash of the salt behind the hidden worlds
    entries/<name>/         what is known of an entry now
    history/<name>/v<k>/    what was known of its earlier versions
    .hipg-bench-draft-*  -ready-*   writers at work, or killed; the next writer cleans up after the dead

A draft is built beside the entries and takes its place by one rename, so whoever is killed leaves the board
as it was. Where an entry is replaced, the rename to ``.hipg-bench-ready-<name>`` decides; what is left to do
after it, the next one who opens the board does.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import shutil
import tempfile
from collections.abc import Callable, Generator
from pathlib import Path

from filelock import FileLock, Timeout

from hipg_bench.errors import BoardError, UnknownNameError, hint
from hipg_bench.leaderboard.entry import Entry, read_entry
from hipg_bench.leaderboard.rows import unpack
from hipg_bench.paths import replacing, write_text

_DRAFT, _READY = ".hipg-bench-draft-", ".hipg-bench-ready-"


class Board:
    """A board's folder.

    Args:
        root: the folder; made when something is first written to it.
    """

    def __init__(self, root: Path) -> None:
        self.root = root.resolve()

    def names(self) -> tuple[str, ...]:
        """Names of the entries; a folder that is missing has none, and is not made."""
        if not self.root.is_dir():
            return ()
        with self._alone():
            return self._names()

    def folder(self, name: str) -> Path:
        """An entry's folder.

        Raises:
            UnknownNameError: no such entry; the message holds the nearest name.
        """
        if name not in self.names():
            raise UnknownNameError(f"no entry {name!r} in {self.root}{hint(name, self._names())}")
        return self._place(name)

    def entry(self, name: str) -> Entry:
        """What is known of an entry.

        Raises:
            UnknownNameError: no such entry.
            SpecError: its ``entry.json`` is damaged.
        """
        return read_entry(self.folder(name))

    @contextlib.contextmanager
    def draft(self, name: str, replaces: Entry | None = None) -> Generator[Path]:
        """Yield an empty folder to fill; it becomes the entry when the block ends well.

        Args:
            name: the entry's.
            replaces: the entry as it was read; None for a new name.

        Raises:
            BoardError: the name is taken, or the entry is no longer the one that was read.
        """
        with self.workspace(name, lambda: self._check(name, replaces)) as draft:
            yield draft
            with self._alone():
                self._check(name, replaces)
                self._publish(name, draft, replaces)

    @contextlib.contextmanager
    def workspace(self, name: str = "work", check: Callable[[], None] = lambda: None) -> Generator[Path]:
        """Yield an empty folder, which goes at the end; a killed process's goes with the next writer.

        Args:
            name: part of the folder's.
            check: called before it is made, while nobody else renames things here.
        """
        with self._alone():
            check()
            folder = Path(tempfile.mkdtemp(prefix=f"{_DRAFT}{name}-", dir=self.root))
            # held while we live: this tells our folder from one of a dead process
            alive = FileLock(_lock_of(folder))
            alive.acquire()
        try:
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            alive.release()
            _lock_of(folder).unlink(missing_ok=True)

    def next_version(self, name: str) -> int:
        """One more than any version of an entry that the board has or had."""
        had = [int(path.name[1:]) for path in self._history(name).glob("v*") if path.name[1:].isdecimal()]
        now = [self.entry(name).version] if name in self._names() else []
        return 1 + max([*had, *now], default=0)

    def write(self, folder: Path, entry: Entry) -> None:
        """Write ``entry.json`` into a draft."""
        write_text(folder / "entry.json", entry.model_dump_json(indent=2) + "\n")

    def publish_rows(self, private: Path) -> tuple[int, list[str]]:
        """Copy rows of hidden worlds into their entries, now that the salt is known to all.

        Args:
            private: where they were kept, as `salt.private_folder` says.

        Returns:
            How many files were copied, and those that are missing or not what their hash promised.
        """
        copied, wrong = 0, list[str]()
        with self._alone():
            for name in self._names():
                entry = read_entry(self._place(name))
                for path, digest in entry.rows.items():
                    if not path.startswith("hidden/"):
                        continue
                    kept = private / name / f"v{entry.version}" / path
                    if _is_as_promised(kept, digest):
                        with replacing(self._place(name) / path) as temporary:
                            shutil.copyfile(kept, temporary)
                        copied += 1
                    else:
                        wrong.append(f"{name}: {path}")
        return copied, wrong

    @contextlib.contextmanager
    def _alone(self) -> Generator[None]:
        """Take the board's lock; clean up what killed processes left."""
        if not self.root.is_dir():
            self.root.mkdir(parents=True, exist_ok=True)
        with FileLock(self.root / ".lock"):
            self._clean()
            yield

    def _names(self) -> tuple[str, ...]:
        return tuple(sorted(path.parent.name for path in (self.root / "entries").glob("*/entry.json")))

    def _history(self, name: str) -> Path:
        return self.root / "history" / name

    def _place(self, name: str) -> Path:
        return self.root / "entries" / name

    def _check(self, name: str, replaces: Entry | None) -> None:
        there = read_entry(self._place(name)) if name in self._names() else None
        if there is not None and replaces is None:
            raise BoardError(f"the board has an entry {name!r} already: choose another name, or --replace it")
        if there != replaces:
            raise BoardError(
                f"entry {name!r} changed while this was running: nothing was written; run it again"
            )

    def _publish(self, name: str, draft: Path, replaces: Entry | None) -> None:
        (self.root / "entries").mkdir(exist_ok=True)
        draft.chmod(0o755)
        if replaces is None:
            draft.rename(self._place(name))
        else:
            ready = self.root / f"{_READY}{name}"
            draft.rename(ready)
            self._finish(ready)

    def _finish(self, ready: Path) -> None:
        """Move an entry that is decided upon to its place, and the one there out of the way."""
        name = ready.name.removeprefix(_READY)
        place = self._place(name)
        if place.exists():
            earlier = read_entry(place).version
            if earlier < read_entry(ready).version:
                kept = self._history(name) / f"v{earlier}"
                kept.parent.mkdir(parents=True, exist_ok=True)
                copies = 1
                while kept.exists():  # somebody moved entries by hand: nothing in the history is overwritten
                    copies += 1
                    kept = self._history(name) / f"v{earlier}-{copies}"
                place.rename(kept)
            else:
                place.rename(self.root / f"{_DRAFT}{name}-old-{os.getpid()}")
        ready.rename(place)
        self._clean_drafts()

    def _clean(self) -> None:
        for ready in self.root.glob(f"{_READY}*"):
            self._finish(ready)
        self._clean_drafts()

    def _clean_drafts(self) -> None:
        """Remove the drafts of processes that are no more."""
        for lock in self.root.glob(f"{_DRAFT}*.lock"):
            if not lock.with_suffix("").exists():
                self._remove_stale_draft(lock.with_suffix(""))
        for draft in self.root.glob(f"{_DRAFT}*"):
            if draft.is_dir():
                self._remove_stale_draft(draft)

    @staticmethod
    def _remove_stale_draft(draft: Path) -> None:
        lock = FileLock(_lock_of(draft))
        try:
            lock.acquire(timeout=0)
        except Timeout:
            return
        shutil.rmtree(draft, ignore_errors=True)
        lock.release()
        _lock_of(draft).unlink(missing_ok=True)


def _is_as_promised(rows: Path, digest: str) -> bool:
    try:
        return rows.is_file() and hashlib.sha256(unpack(rows)).hexdigest() == digest
    except BoardError:  # damaged: the others are published nevertheless
        return False


def _lock_of(draft: Path) -> Path:
    return draft.with_name(draft.name + ".lock")
