"""The store: an entry appears whole or not at all, whoever else writes and whoever is killed."""

import hashlib
import json
import os
import signal
import stat
import subprocess
import sys

import pytest

from hipg_bench.errors import BoardError, UnknownNameError
from hipg_bench.leaderboard import salt
from hipg_bench.leaderboard.board import Board
from hipg_bench.leaderboard.entry import Entry, Verification
from hipg_bench.leaderboard.rows import compare, pack, unpack

SUITE = "hipg-1"


def entry(name="alpha", version=1, **changes):
    return Entry(
        name=name, version=version, added="2026-01-01T00:00:00+00:00", suite=SUITE, tier=0, bundle=None,
        policies={"hazard_nav-4": {0: "ab"}}, claimed=False, sandbox="not needed",
        execution="decentralised", rows={}, **changes,
    )  # fmt: skip


def add(board, name="alpha", version=1, replaces=None, content="rows"):
    with board.draft(name, replaces) as folder:
        for part in ("a", "b", "c"):
            (folder / part).mkdir()
            (folder / part / "rows").write_text(content)
        board.write(folder, entry(name, version))


def contents(root):
    """Everything a reader of the board can see."""
    return {
        path.relative_to(root).as_posix(): path.read_text()
        for kind in ("entries", "history")
        for path in (root / kind).rglob("*")
        if path.is_file()
    }


def strays(root):
    return [path.name for path in root.iterdir() if path.name.startswith((".draft", ".ready"))]


def test_an_entry_is_there_after_the_block_and_not_before(tmp_path):
    board = Board(tmp_path)
    with board.draft("alpha") as folder:
        board.write(folder, entry())
        assert board.names() == ()
    assert board.names() == ("alpha",)
    assert board.entry("alpha") == entry()
    with pytest.raises(UnknownNameError, match="did you mean 'alpha'"):
        board.entry("alpa")


def test_a_name_is_taken_once(tmp_path):
    board = Board(tmp_path)
    add(board)
    with pytest.raises(BoardError, match="has an entry 'alpha' already"):
        add(board)


def test_a_block_that_fails_leaves_nothing(tmp_path):
    board = Board(tmp_path)

    def fail():
        with board.draft("alpha") as folder:
            board.write(folder, entry())
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        fail()
    assert board.names() == ()
    assert strays(tmp_path) == []


def test_a_new_version_keeps_the_old_one(tmp_path):
    board = Board(tmp_path)
    add(board, content="first")
    add(board, version=2, replaces=board.entry("alpha"), content="second")
    seen = contents(tmp_path)
    assert seen["entries/alpha/a/rows"] == "second"
    assert seen["history/alpha/v1/a/rows"] == "first"
    # the same version again, as a verification writes it, has no history
    checked = entry(version=2, verification=None).model_copy(update={"claimed": True})
    with board.draft("alpha", board.entry("alpha")) as folder:
        board.write(folder, checked)
    assert board.entry("alpha") == checked
    assert set(contents(tmp_path / "history")) == set()
    assert sorted(path.name for path in (tmp_path / "history/alpha").iterdir()) == ["v1"]
    assert strays(tmp_path) == []


def test_what_changed_meanwhile_is_not_overwritten(tmp_path):
    board = Board(tmp_path)
    add(board)
    read = board.entry("alpha")

    def slow():
        with board.draft("alpha", read) as folder:
            board.write(folder, entry(version=2))
            add(board, version=2, replaces=read, content="faster")

    with pytest.raises(BoardError, match="changed while this was running"):
        slow()
    assert contents(tmp_path)["entries/alpha/a/rows"] == "faster"


FORKER = """
import json, os, pathlib, signal, sys
sys.path.insert(0, {tests!r})
from hipg_bench.leaderboard.board import Board
import test_board

EVENTS = ("open", "os.rename", "os.mkdir", "os.remove", "os.rmdir", "shutil.rmtree", "os.chmod")

def write(root, fatal, replacing, name):
    touches = 0
    def hook(event, args):
        nonlocal touches
        if event in EVENTS and any(root in str(argument) for argument in args):
            touches += 1
            if touches == fatal:
                os.kill(os.getpid(), signal.SIGKILL)
    board = Board(pathlib.Path(root))
    old = board.entry(name) if replacing else None
    sys.addaudithook(hook)
    try:
        test_board.add(board, name, 2 if replacing else 1, old, "new")
    except test_board.BoardError as error:
        print(error, file=sys.stderr, flush=True)
        return 255
    return touches

pids = []
for job in json.loads(sys.argv[1]):
    pid = os.fork()
    if pid == 0:
        os._exit(write(*job))
    pids.append(pid)
print(json.dumps([os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) for pid in pids]))
"""


def write_at_once(*jobs):
    """Processes that add or replace an entry: (root, touch of the board that kills it, replace, name).

    Returns:
        Each one's exit code, which is how often it touched the board's files, and what they said.
    """
    code = FORKER.format(tests=os.path.dirname(__file__))
    arguments = [(str(root), *rest) for root, *rest in jobs]
    done = subprocess.run(
        [sys.executable, "-c", code, json.dumps(arguments)],
        capture_output=True, text=True, timeout=60, check=True,
    )  # fmt: skip
    return json.loads(done.stdout), done.stderr


@pytest.mark.parametrize("how", ["add", "replace"])
def test_killed_at_any_moment_the_board_is_as_it_was_or_as_it_should_be(tmp_path, how):
    def fresh(name):
        root = tmp_path / name
        add(Board(root), "other")
        if how == "replace":
            add(Board(root), content="old")
        return root

    before, whole = contents(fresh("before")), fresh("whole")
    ((touches,), _) = write_at_once((whole, 0, how == "replace", "alpha"))
    after = contents(whole)
    assert touches > 10
    assert before != after
    roots = [fresh(f"cut{k}") for k in range(1, touches + 1)]
    codes, _ = write_at_once(*((root, k, how == "replace", "alpha") for k, root in enumerate(roots, start=1)))
    assert codes == [-signal.SIGKILL] * touches
    decided = []
    for root in roots:
        board = Board(root)
        names = board.names()
        assert contents(root) in (before, after), root.name
        decided.append(contents(root) == after)
        assert names == (("alpha", "other") if how == "replace" or decided[-1] else ("other",))
        # the next writer finds a clean table and gets its way
        assert strays(root) == []
        add(board, "third")
        assert "third" in board.names()
    # once decided, never undecided
    assert decided == sorted(decided)
    assert not decided[0]


def test_many_processes_adding_at_once_lose_nothing(tmp_path):
    names = [f"agent{k}" for k in range(8)]
    codes, said = write_at_once(*((tmp_path, 0, False, name) for name in names))
    assert 255 not in codes
    assert said == ""
    assert Board(tmp_path).names() == tuple(names)
    assert strays(tmp_path) == []


def test_of_many_adds_of_one_name_one_wins_and_the_others_are_told(tmp_path):
    codes, said = write_at_once(*[(tmp_path, 0, False, "alpha")] * 5)
    assert codes.count(255) == 4
    assert said.count("has an entry 'alpha' already") == 4
    assert contents(tmp_path)["entries/alpha/c/rows"] == "new"


def test_a_writer_at_work_is_not_cleaned_away(tmp_path):
    board = Board(tmp_path)
    with board.draft("alpha") as folder:
        add(Board(tmp_path), "beta")
        assert folder.is_dir()
        board.write(folder, entry())
    assert board.names() == ("alpha", "beta")


def verification(**changes):
    return Verification(
        **{
            "date": "2026-01-02T00:00:00+00:00", "outcome": "verified", "commitment": "c0ffee",
            "sandbox": "not needed", "compared": 320, "execution": "decentralised",
        } | changes
    )  # fmt: skip


def test_badges():
    assert entry().status("c0ffee") == "self-reported"
    assert entry(verification=verification()).status("c0ffee") == "verified"
    # the hidden worlds are others now
    assert entry(verification=verification()).status("0ther") == "outdated"
    for outcome in ("mismatch", "unsandboxed"):
        assert entry(verification=verification(outcome=outcome)).status("c0ffee") == outcome


def test_the_salt_is_drawn_once_kept_secret_and_revealed(tmp_path):
    board, file = tmp_path / "board", tmp_path / "secret" / "salt"
    made = salt.new_salt(board, file, SUITE)
    assert stat.S_IMODE(file.stat().st_mode) == 0o600
    text = file.read_text().strip()
    # SHA-256 of the raw bytes, and nothing of the salt itself, is on the board
    assert made.sha256 == hashlib.sha256(bytes.fromhex(text)).hexdigest()
    published = (board / "commitment.json").read_text()
    assert json.loads(published)["current"]["sha256"] == made.sha256
    assert text not in published
    assert salt.read_salt(board, file) == bytes.fromhex(text)
    with pytest.raises(BoardError, match="reveal that one first"):
        salt.new_salt(board, tmp_path / "another", SUITE)
    salt.reveal_salt(board, file)
    (past,) = salt.read_commitments(board).past
    assert hashlib.sha256(bytes.fromhex(past.salt)).hexdigest() == past.sha256 == made.sha256
    with pytest.raises(BoardError, match="never overwritten"):
        salt.new_salt(board, file, SUITE)
    second = salt.new_salt(board, tmp_path / "another", SUITE)
    assert second.sha256 != made.sha256
    with pytest.raises(BoardError, match="not the salt that"):
        salt.read_salt(board, file)


def test_salts_where_others_could_find_them_are_refused(tmp_path):
    board, file = tmp_path / "board", tmp_path / "salt"
    repository = tmp_path / "repository"
    (repository / ".git").mkdir(parents=True)
    for inside in (board / "salt", repository / "deep" / "salt"):
        with pytest.raises(BoardError, match="keep the salt outside"):
            salt.new_salt(board, inside, SUITE)
        assert not inside.exists()
    with pytest.raises(BoardError, match="bound to no salt"):
        salt.read_salt(board, file)
    salt.new_salt(board, file, SUITE)
    file.chmod(0o640)
    with pytest.raises(BoardError, match="chmod 600"):
        salt.read_salt(board, file)
    file.chmod(0o600)
    link = repository / "link"
    link.symlink_to(file)
    # the link is in the repository, what it points at is not
    assert salt.read_salt(board, link)
    file.rename(repository / "salt")
    with pytest.raises(BoardError, match="keep the salt outside"):
        salt.read_salt(board, repository / "salt")
    for content, message in (("hello", "holds no salt"), ("00" * 8, "holds 8 bytes")):
        (tmp_path / "bad").write_text(content)
        (tmp_path / "bad").chmod(0o600)
        with pytest.raises(BoardError, match=message):
            salt.read_salt(board, tmp_path / "bad")


def row(world, **changes):
    return (
        json.dumps({"train_seed": 0, "world": world, "return": -12.5, "deaths": 1} | changes).encode() + b"\n"
    )


def test_rows_are_packed_the_same_way_each_time(tmp_path):
    text = row(0) + row(1)
    digests = {pack(text, tmp_path / name) for name in ("a.gz", "b.gz")}
    assert digests == {hashlib.sha256(text).hexdigest()}
    assert (tmp_path / "a.gz").read_bytes() == (tmp_path / "b.gz").read_bytes()
    assert unpack(tmp_path / "a.gz") == text
    (tmp_path / "a.gz").write_bytes((tmp_path / "a.gz").read_bytes()[:-3])
    with pytest.raises(BoardError, match="damaged"):
        unpack(tmp_path / "a.gz")


def test_a_row_altered_by_a_billionth_is_found():
    claimed, got = row(0) + row(1, **{"return": -12.5 + 1e-9}), row(0) + row(1)
    (found,) = compare("standard", "t", claimed, got)
    assert (found.train_seed, found.world) == (0, 1)
    assert found.fields == {"return": (-12.499999999, -12.5)}
    assert found.what == "return: claimed -12.499999999, got -12.5"
    assert compare("standard", "t", got, got) == []


def test_missing_extra_and_rewritten_rows_are_found():
    assert [one.what for one in compare("s", "t", row(0), row(0) + row(1))] == ["not claimed"]
    assert [one.what for one in compare("s", "t", row(0) + row(1), row(0))] == [
        "claimed, but there is no such world"
    ]
    respaced = row(0).replace(b", ", b",")
    assert [one.what for one in compare("s", "t", respaced, row(0))] == [
        "the same numbers, written otherwise"
    ]
    for nonsense in (b"{", b"[]\n", b'{"train_seed": true, "world": 0}\n', b'{"world": 0}\n'):
        with pytest.raises(BoardError, match="a line is"):
            compare("s", "t", nonsense, row(0))
