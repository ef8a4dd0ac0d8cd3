"""``hipg-bench leaderboard``: entries, their verification, and the page."""

from __future__ import annotations

import contextlib
import functools
import http.server
import tempfile
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hipg_bench.cli import console

if TYPE_CHECKING:
    from hipg_bench.leaderboard.entry import Verification
    from hipg_bench.leaderboard.playing import BoardEvaluation

app = typer.Typer(
    help="Add agents to the leaderboard, verify their scores, build its website.", no_args_is_help=True
)
salts = typer.Typer(help="Manage the secret salt that determines the hidden worlds.", no_args_is_help=True)
app.add_typer(salts, name="salt")

BoardFolder = Annotated[Path, typer.Option("--board", help="The board's folder.")]
Salt = Annotated[
    Path, typer.Option("--salt-file", help="File with the secret salt, stored outside any repository.")
]
Threads = Annotated[
    int, typer.Option(min=0, help="Physics threads; 0 uses all cores. Results do not depend on it.")
]
Trust = Annotated[
    bool,
    typer.Option(
        "--trust", help="Run the agent's code without a sandbox; only for your own code, and never verified."
    ),
]
BOARD = Path("leaderboard")


@app.command()
def add(
    what: Annotated[str, typer.Argument(help="A submission's zip or folder, or a bundled agent's name.")],
    board: BoardFolder = BOARD,
    claims: Annotated[
        Path | None, typer.Option(help="Folder with the submitter's own episode rows in <split>/episodes/.")
    ] = None,
    splits: Annotated[str, typer.Option(help="Comma-separated splits, or all.")] = "all",
    tasks: Annotated[str, typer.Option(help="Comma-separated task names, or standard.")] = "standard",
    episodes: Annotated[int, typer.Option(min=3, help="Worlds per policy; a full entry has 320.")] = 320,
    films: Annotated[
        str, typer.Option(help="Comma-separated tasks to record videos of, or all, or none.")
    ] = "all",
    replace: Annotated[bool, typer.Option("--replace", help="Overwrite the entry of the same name.")] = False,
    trust: Trust = False,
    threads: Threads = 0,
) -> None:
    """Add an agent as a self-reported entry: evaluate it in the public worlds, or import its rows."""
    from hipg_bench.leaderboard import adding
    from hipg_bench.leaderboard.board import Board
    from hipg_bench.leaderboard.source import opened

    evaluation, store = _evaluation(splits, tasks, episodes, threads), Board(board)
    with store.workspace("add") as place, opened(what, place, trust=trust) as source, _telling() as progress:
        added = adding.add(
            store, source, evaluation, claims=claims, replace=replace,
            film_tasks=_filmed(films, evaluation), progress=progress,
        )  # fmt: skip
    _tell_trouble(added.trouble)
    entry = added.entry
    console.say(
        f"{entry.name} is on the board, {entry.status(None)}: "
        f"{sum(len(seeds) for seeds in entry.policies.values())} policies for {len(entry.policies)} tasks"
    )


@app.command()
def verify(
    name: Annotated[str, typer.Argument(help="The entry's name.")],
    salt_file: Salt,
    board: BoardFolder = BOARD,
    trust: Trust = False,
    threads: Threads = 0,
) -> None:
    """Verify an entry: reproduce its public rows, then evaluate it in hidden worlds."""
    from hipg_bench.leaderboard import verify as verifying
    from hipg_bench.leaderboard.board import Board
    from hipg_bench.leaderboard.salt import private_folder, read_salt

    with _telling() as progress:
        found = verifying.verify(
            Board(board), name, read_salt(board, salt_file), private_folder(salt_file),
            trust=trust, threads=threads, progress=progress,
        )  # fmt: skip
    _report(name, found)
    if found.outcome != "verified":
        raise typer.Exit(1)


@app.command()
def build(
    out: Annotated[
        Path,
        typer.Option(help="Output folder of the website. A website that this command built is overwritten."),
    ],
    board: BoardFolder = BOARD,
) -> None:
    """Build the leaderboard as a static website that works offline."""
    from hipg_bench.leaderboard import site
    from hipg_bench.leaderboard.board import Board

    view = site.build(Board(board), out)
    console.say(f"{len(view.entries)} entries")
    for reason in view.left_out.values():
        console.warn(f"left out: {reason}")
    console.say(f"{out / 'index.html'}")


@app.command()
def serve(
    board: BoardFolder = BOARD,
    port: Annotated[int, typer.Option(min=0, max=65535, help="Port; 0 selects a free one.")] = 8000,
) -> None:
    """Build the website and serve it on this machine only."""
    from hipg_bench.leaderboard import site
    from hipg_bench.leaderboard.board import Board

    with tempfile.TemporaryDirectory(prefix="hipg-site-") as place:
        folder = Path(place) / "site"
        site.build(Board(board), folder)
        handler = functools.partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
        with http.server.ThreadingHTTPServer(("127.0.0.1", port), handler) as server:
            console.say(f"http://127.0.0.1:{server.server_port}/ (Ctrl-C ends it)")
            with contextlib.suppress(KeyboardInterrupt):
                server.serve_forever()


@app.command()
def refresh(
    salt_file: Annotated[
        Path | None, typer.Option("--salt-file", help="Also verify the entries with this salt file.")
    ] = None,
    board: BoardFolder = BOARD,
    episodes: Annotated[int, typer.Option(min=3, help="Worlds per policy.")] = 320,
    films: Annotated[
        str, typer.Option(help="Comma-separated tasks to record videos of, or all, or none.")
    ] = "all",
    threads: Threads = 0,
) -> None:
    """Recreate the entries of all bundled agents, overwriting those on the board."""
    from hipg_bench.leaderboard import adding
    from hipg_bench.leaderboard import verify as verifying
    from hipg_bench.leaderboard.board import Board
    from hipg_bench.leaderboard.salt import private_folder, read_salt
    from hipg_bench.leaderboard.source import opened
    from hipg_bench.policies.bundle import agents

    salt = read_salt(board, salt_file) if salt_file else None
    evaluation = _evaluation("all", "standard", episodes, threads)
    for name in agents():
        with _telling() as progress:
            with opened(name) as source:
                added = adding.add(
                    Board(board),
                    source,
                    evaluation,
                    replace=True,
                    film_tasks=_filmed(films, evaluation),
                    progress=progress,
                )
            found = (
                verifying.verify(
                    Board(board), name, salt, private_folder(salt_file), threads=threads, progress=progress
                )
                if salt and salt_file
                else None
            )
        _tell_trouble(added.trouble)
        if found:
            _report(name, found)
        else:
            console.say(f"{name}: self-reported")


@salts.command()
def new(
    file: Annotated[Path, typer.Argument(help="New file for the salt, outside any repository.")],
    board: BoardFolder = BOARD,
) -> None:
    """Generate a salt and publish its hash on the board."""
    from hipg_bench.evaluation.seeds import SUITE
    from hipg_bench.leaderboard.salt import new_salt

    made = new_salt(board, file, SUITE)
    console.say(f"{board / 'commitment.json'} now promises {made.sha256}")
    console.say(f"Keep {file}: without it nothing can be verified. Show it to nobody until you reveal it.")


@salts.command()
def reveal(
    file: Annotated[Path, typer.Argument(help="File with the salt whose hash the board has published.")],
    board: BoardFolder = BOARD,
) -> None:
    """Publish the salt, so that everybody can reproduce the hidden worlds."""
    from hipg_bench.leaderboard.board import Board
    from hipg_bench.leaderboard.salt import private_folder, reveal_salt

    kept = reveal_salt(board, file)
    console.say(f"{board / 'commitment.json'} now holds the salt behind {kept.sha256}")
    copied, wrong = Board(board).publish_rows(private_folder(file))
    console.say(f"{copied} files of rows on hidden worlds are published with their entries")
    for path in wrong:
        console.warn(f"missing or not as promised: {path}")


def _evaluation(splits: str, tasks: str, episodes: int, threads: int) -> BoardEvaluation:
    """What the options say is to be played."""
    from hipg_bench import registry
    from hipg_bench.errors import UnknownNameError, hint
    from hipg_bench.evaluation.splits import SPLITS
    from hipg_bench.leaderboard.playing import SUITE, BoardEvaluation

    chosen = SPLITS if splits == "all" else _names(splits)
    for split in chosen:
        if split not in SPLITS:
            raise UnknownNameError(f"no split {split!r}{hint(split, SPLITS)}")
    names = registry.tagged(SUITE) if tasks == SUITE else _names(tasks)
    for task in names:
        registry.task_spec(task)
    return BoardEvaluation(tuple(names), chosen, episodes, threads)


def _filmed(films: str, evaluation: BoardEvaluation) -> tuple[str, ...]:
    return {"all": evaluation.tasks, "none": ()}.get(films, _names(films))


def _names(text: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(name.strip() for name in text.split(",") if name.strip()))


@contextlib.contextmanager
def _telling() -> Generator[Callable[[str, float, float], None]]:
    """A bar for every stage, as it comes."""
    with console.progress() as bars:
        ids: dict[str, int] = {}

        def tell(stage: str, done: float, total: float) -> None:
            if stage not in ids:
                ids[stage] = bars.add_task(stage, total=total)
            bars.advance(bars.task_ids[ids[stage]], done)

        yield tell


def _tell_trouble(trouble: Sequence[str]) -> None:
    for line in trouble:
        console.warn(f"no film: {line}")


def _report(name: str, found: Verification) -> None:
    """What a verification found."""
    console.say(f"{name}: {found.outcome}, {found.execution}, sandbox {found.sandbox}")
    console.say(f"{found.compared} rows compared, {found.differing} differ")
    for reason in found.reasons:
        console.say(reason)
