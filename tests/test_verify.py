"""From a zip to a badge: what is claimed is played again, and hidden worlds give the score."""

import csv
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from unittest.mock import Mock

import numpy as np
import pytest
from safetensors import safe_open
from safetensors.numpy import load_file, save_file

from hipg_bench.errors import BoardError, BundleError, ResumeError, SpecError
from hipg_bench.evaluation import machines, protocol, runner
from hipg_bench.leaderboard import adding
from hipg_bench.leaderboard import verify as verifying
from hipg_bench.leaderboard.board import Board
from hipg_bench.leaderboard.entry_view import EntryView, read_board
from hipg_bench.leaderboard.playing import BoardEvaluation
from hipg_bench.leaderboard.rows import pack, parse_rows, unpack
from hipg_bench.leaderboard.salt import new_salt, read_salt, reveal_salt
from hipg_bench.leaderboard.source import opened
from hipg_bench.leaderboard.verify import verify
from hipg_bench.paths import data_folder
from hipg_bench.policies.bundle import Agent, load_agent
from hipg_bench.sandbox import choice
from hipg_bench.submissions import archive

TASK = "hazard_nav-4"
EVALUATION = BoardEvaluation((TASK,), ("standard", "forced_death"), episodes=6, threads=1)
SHORT = BoardEvaluation((TASK,), ("standard",), episodes=3, threads=1)
FROZEN = not protocol.differences()
THANKS = 'authors = "A"\nlicense = "MIT"\n'
SANDBOXED = any(result.works for result in choice.probe_all().values())


def network(folder, name="newcomer"):
    """A submission of tier 0: trained weights under a card of its own."""
    (folder / TASK).mkdir(parents=True)
    weights = data_folder("agents") / "mappo_minhealth" / TASK / "seed0.safetensors"
    shutil.copyfile(weights, folder / TASK / "seed0.safetensors")
    shutil.copyfile(weights.with_suffix(".curve.csv"), folder / TASK / "seed0.curve.csv")
    (folder / "agent.toml").write_text(f'name = "{name}"\nsummary = "Learns"\nkind = "network"\n{THANKS}')
    (folder / "README.md").write_text("# A newcomer\n")
    return folder


def python(folder, name, answer):
    """A submission of tier 2."""
    folder.mkdir()
    (folder / "agent.toml").write_text(
        f'name = "{name}"\nsummary = "Acts"\nkind = "python"\nentry_point = "own:make_agent"\n{THANKS}'
        f"[tasks]\n{TASK!r} = [0]\n"
    )
    (folder / "README.md").write_text("# An agent\n")
    (folder / "own.py").write_text(
        "import numpy as np\n"
        "class Agent:\n"
        "    def reset(self, seeds): pass\n"
        f"    def act(self, observation, alive): return {answer}\n"
        "def make_agent(task, train_seed): return Agent()\n"
    )
    return folder


def zipped(folder):
    path = folder.with_suffix(".zip")
    archive.pack(folder, path)
    return path


def add(board, what, match=EVALUATION, trust=False, **options):
    with opened(what, trust=trust) as source:
        return adding.add(board, source, match, **options).entry


@pytest.fixture(autouse=True)
def frozen(monkeypatch):
    """Whether the tree is the frozen suite is another test's business."""
    monkeypatch.setattr(protocol, "differences", list)


def test_a_tree_that_is_not_the_frozen_suite_verifies_nothing(board, salted, tmp_path, monkeypatch):
    monkeypatch.setattr(protocol, "differences", lambda: ["tasks.x: floor was -1, is -2"])
    with pytest.raises(BoardError, match=r"the tree is not hipg-1.*floor was -1, is -2"):
        verify(board, "newcomer", salted[1], tmp_path / "private", threads=1)
    assert board.entry("newcomer").verification is None


def test_where_last_bits_differ_nothing_is_verified(board, salted, tmp_path, monkeypatch):
    monkeypatch.setattr(machines, "why_rows_may_differ", lambda: "this processor has no FMA instructions")
    with pytest.raises(BoardError, match="nothing is verified here: this processor has no FMA"):
        verify(board, "newcomer", salted[1], tmp_path / "private", threads=1)


@pytest.fixture(scope="module")
def salted(tmp_path_factory):
    """A board that is bound to a salt, the salt, and a newcomer's zip, which is on it."""
    place = tmp_path_factory.mktemp("board")
    board = Board(place / "board")
    new_salt(board.root, place / "salt", "hipg-1")
    package = zipped(network(place / "newcomer"))
    add(board, package)
    return board, read_salt(board.root, place / "salt"), package


@pytest.fixture
def board(salted, tmp_path):
    """A copy of that board for one test."""
    shutil.copytree(salted[0].root, tmp_path / "board")
    return Board(tmp_path / "board")


@pytest.fixture(scope="module")
def rows(tmp_path_factory, salted):
    """What the newcomer's own evaluation of six worlds gave, as the command writes it."""
    place = tmp_path_factory.mktemp("claims")
    with opened(salted[2]) as source:
        for split in EVALUATION.splits:
            runner.evaluate(source.agent, EVALUATION.suite(), place / split, EVALUATION.job(split))
    return place


def altered(claims, place, change):
    """Claims in which one row of the standard split is another."""
    shutil.copytree(claims, place)
    path = place / "standard" / "episodes" / f"{TASK}.jsonl"
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    change(lines[4])
    path.write_text("".join(json.dumps(line) + "\n" for line in lines))
    return place


def test_a_zip_becomes_an_entry(salted):
    board, _, package = salted
    (shown,) = read_board(board)
    assert (shown.status, shown.worlds, shown.kind) == ("self-reported", "public", "checkpoint")
    assert shown.entry.bundle == hashlib.sha256(package.read_bytes()).hexdigest()
    assert shown.entry.tier == 0
    assert shown.readme == "# A newcomer\n"
    found = shown.rows("public", "standard", TASK)
    assert [row["world"] for row in found] == list(range(6))
    # the same rows as the agent plays by itself
    with opened(package) as source:
        spec = EVALUATION.suite().specs[0]
        own = EVALUATION.job("standard").play_all(spec, source.agent.policy(spec, 0))
    assert [row["return"] for row in found] == [row["return"] for row in own]
    # a curve is two columns of numbers, thinned, with the last point kept
    (points,) = shown.curves[TASK].values()
    assert len(points) <= adding.CURVE_POINTS
    last = (data_folder("agents") / "mappo_minhealth" / TASK).glob("*.curve.csv")
    evaluated = [row for row in csv.DictReader(next(last).open()) if row["eval_return"]]
    assert points[-1] == (float(evaluated[-1]["steps"]), float(evaluated[-1]["eval_return"]))
    assert not list(board.root.rglob(".work"))


def test_what_is_true_is_verified_on_hidden_worlds(board, salted, tmp_path):
    _, salt, _ = salted
    found = verify(board, "newcomer", salt, tmp_path / "private", threads=1)
    assert (found.outcome, found.sandbox, found.execution) == ("verified", "not needed", "decentralised")
    assert (found.compared, found.differing) == (12, 0)
    (shown,) = read_board(board)
    assert (shown.status, shown.worlds) == ("verified", "hidden")
    for split in EVALUATION.splits:
        public = shown.rows("public", split, TASK)
        kept = tmp_path / "private" / "newcomer" / "v1" / f"hidden/{split}/episodes/{TASK}.jsonl.gz"
        hidden = [json.loads(line) for line in unpack(kept).splitlines()]
        assert (
            hashlib.sha256(unpack(kept)).hexdigest()
            == shown.entry.rows[f"hidden/{split}/episodes/{TASK}.jsonl.gz"]
        )
        assert [row["eval_seed"] for row in public] == [1000] * 6
        # nobody learns which worlds they are
        assert [row["eval_seed"] for row in hidden] == [None] * 6
        assert {row["return"] for row in hidden}.isdisjoint({row["return"] for row in public})
        # the seed as the protocol documents it, worked out by hand
        message = f"hipg-1|{split}|{TASK}|0".encode()
        inner = hashlib.sha256(bytes(b ^ 0x36 for b in salt.ljust(64, b"\0")) + message).digest()
        digest = hashlib.sha256(bytes(b ^ 0x5C for b in salt.ljust(64, b"\0")) + inner).digest()
        assert EVALUATION.job(split, salt).eval_seed(TASK, 0) == int.from_bytes(digest[:8], "big") >> 1
    published = b"".join(
        unpack(path) if path.suffix == ".gz" else path.read_bytes()
        for path in board.root.rglob("*") if path.is_file()
    )  # fmt: skip
    # what an agent does in a hidden world could tell what it saw there
    assert not list(board.root.rglob("hidden/*/episodes"))
    for row in hidden:
        assert json.dumps(row["return"]).encode() not in published
    result = json.loads((shown.folder / "hidden/standard/results.json").read_text())
    scores = [run["score"] for task in result["tasks"] for run in task["runs"]]
    assert scores == [float(f"{score:.3g}") for score in scores]
    seed = EVALUATION.job("standard", salt).eval_seed(TASK, 0)
    assert salt.hex().encode() not in published
    assert str(seed).encode() not in published
    # verified twice, it is the same entry once, with no history
    verify(board, "newcomer", salt, tmp_path / "private", threads=1)
    assert not (board.root / "history").exists()


def test_after_the_salt_is_revealed_it_is_outdated(board, salted, tmp_path):
    _, salt, _ = salted
    verify(board, "newcomer", salt, tmp_path / "private", threads=1)
    (tmp_path / "salt").write_text(salt.hex())
    (tmp_path / "salt").chmod(0o600)
    reveal_salt(board.root, tmp_path / "salt")
    assert board.publish_rows(tmp_path / "private") == (2, [])
    (shown,) = read_board(board)
    assert len(shown.rows("hidden", "standard", TASK)) == 6
    assert read_board(board)[0].status == "outdated"
    with pytest.raises(BoardError, match="not the one"):
        verify(board, "newcomer", salt, tmp_path / "private", threads=1)
    new_salt(board.root, tmp_path / "second", "hipg-1")
    verify(board, "newcomer", read_salt(board.root, tmp_path / "second"), tmp_path / "private", threads=1)
    assert read_board(board)[0].status == "verified"


def test_true_claims_are_verified(tmp_path, salted, rows):
    board = Board(tmp_path / "board")
    new_salt(board.root, tmp_path / "salt", "hipg-1")
    assert add(board, salted[2], claims=rows).claimed
    found = verify(
        board, "newcomer", read_salt(board.root, tmp_path / "salt"), tmp_path / "private", threads=1
    )
    assert (found.outcome, found.compared) == ("verified", 12)


def test_the_seed_that_an_agent_is_told_differs_at_each_verification():
    """In hidden worlds: else a throw-away submission could learn to recognise them."""
    salt = bytes(range(32))
    jobs = [
        EVALUATION.job("standard", salt, agent_seed_key) for agent_seed_key in ("one|1|2026", "one|1|2027")
    ]
    assert len({job.agent_seed(TASK, 0) for job in jobs}) == 2
    assert len({job.eval_seed(TASK, 0) for job in jobs}) == 1
    assert EVALUATION.job("standard").agent_seed(TASK, 0) == 1000


def test_copies_of_one_training_are_not_several(tmp_path):
    """Neither by content nor, where code hides it, by what they do."""
    folder = network(tmp_path / "copied", "copied")
    tensors = load_file(folder / TASK / "seed0.safetensors")
    with safe_open(folder / TASK / "seed0.safetensors", "numpy") as file:
        metadata = file.metadata()
    save_file(tensors, folder / TASK / "seed1.safetensors", metadata | {"note": "another file"})
    with pytest.raises(BundleError, match="training seeds 0 and 1 are the same policy"):
        add(Board(tmp_path / "board"), folder)
    (folder / TASK / "seed1.safetensors").rename(folder / TASK / "seed01.safetensors")
    with pytest.raises(BundleError, match="without leading zeros, such as seed1"):
        add(Board(tmp_path / "board"), folder)


@pytest.mark.skipif(not SANDBOXED, reason="no sandbox works on this machine")
def test_code_that_ignores_its_training_seed_was_trained_once(tmp_path):
    folder = python(tmp_path / "one", "one", "np.tanh(observation[..., :3])")
    card = (folder / "agent.toml").read_text().replace("= [0]", "= [0, 1]")
    (folder / "agent.toml").write_text(card)
    with pytest.raises(BundleError, match="training seeds 0 and 1 played alike in the 3 worlds"):
        add(Board(tmp_path / "board"), folder, SHORT)


@pytest.mark.parametrize("seed_of_copy", [1, 2])
def test_near_copies_of_one_training_are_not_several(tmp_path, seed_of_copy):
    """A weight that is moved a little makes no training of its own."""
    folder = network(tmp_path / "near", "near")
    first = folder / TASK / "seed0.safetensors"
    with safe_open(first, "numpy") as file:
        metadata = file.metadata()
    tensors = load_file(first)
    name = sorted(tensors)[0]
    tensors[name] = tensors[name] + np.float32(seed_of_copy * 2.0**-15)
    save_file(tensors, folder / TASK / f"seed{seed_of_copy}.safetensors", metadata)
    with pytest.raises(
        BundleError, match=f"training seeds 0 and {seed_of_copy} played alike in the 3 worlds"
    ):
        add(Board(tmp_path / "board"), folder, SHORT)


def outcomes(claims, folder, returns):
    """Rows of training seeds with given returns, None for an episode that failed."""
    row = json.loads((claims / "standard/episodes" / f"{TASK}.jsonl").read_text().splitlines()[0])
    lines = [
        row | {"train_seed": seed, "world": world, "episode_id": world}
        | ({"status": "not_finite"} if value is None else {"return": value})
        for seed, values in enumerate(returns) for world, value in enumerate(values)
    ]  # fmt: skip
    (folder / "episodes").mkdir()
    (folder / "episodes" / f"{TASK}.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    return folder


@pytest.mark.parametrize(
    ("returns", "alike"),
    [
        ([[1.0, 2.0, 3.0], [1.0, 2.0, None]], True),  # it failed in one world on purpose
        ([[1.0, 2.0, 3.0], [1.0001, 2.0001, 9.0]], True),  # and played otherwise in one
        ([[5.0, 5.0, 5.0], [5.0, 5.0, 5.0]], True),
        ([[1.0, 2.0, 3.0], [1.1, 2.1, 3.1]], False),
        ([[5.0, 5.0, 5.0], [5.1, 5.1, 5.1]], False),
        ([[1.0, None, None], [None, 1.0, None]], False),  # nothing to compare
    ],
)
def test_what_is_alike(tmp_path, rows, returns, alike):
    run = outcomes(rows, tmp_path, returns)
    if alike:
        with pytest.raises(BundleError, match="played alike"):
            adding._refuse_alike(run)
    else:
        adding._refuse_alike(run)


@pytest.mark.parametrize("kind", ["another task", "unplayed task", "pipe", "device"])
def test_claims_of_other_tasks_or_of_no_files_are_refused(tmp_path, salted, rows, kind):
    shutil.copytree(rows, tmp_path / "claims")
    episodes = tmp_path / "claims" / "standard" / "episodes"
    real = episodes / f"{TASK}.jsonl"
    match, said = EVALUATION, "does not play here"
    if kind == "another task":
        shutil.copyfile(real, episodes / "coop_nav-3.jsonl")
    elif kind == "unplayed task":
        shutil.copyfile(real, episodes / "coop_nav-3.jsonl")
        match = BoardEvaluation((TASK, "coop_nav-3"), EVALUATION.splits, episodes=6, threads=1)
    else:
        real.unlink()
        os.mkfifo(real) if kind == "pipe" else real.symlink_to("/dev/zero")
        said = "links, pipes and devices are not allowed"
    board = Board(tmp_path / "board")
    with pytest.raises(BoardError, match=said):
        add(board, salted[2], match, claims=tmp_path / "claims")
    assert board.names() == ()


@pytest.mark.parametrize("path", ["standard/episodes/coop_nav-3.jsonl.gz", f"shift/episodes/{TASK}.jsonl.gz"])
def test_rows_that_nobody_plays_again_are_no_verified_ones(board, salted, tmp_path, path):
    """However a file came into an entry, it counts."""
    folder = board.folder("newcomer")
    entry = json.loads((folder / "entry.json").read_text())
    text = unpack(folder / f"standard/episodes/{TASK}.jsonl.gz")
    entry["rows"][path] = pack(text, folder / path)
    (folder / "entry.json").write_text(json.dumps(entry))
    found = verify(board, "newcomer", salted[1], tmp_path / "private", threads=1)
    assert found.outcome == "mismatch"


def test_revealing_goes_on_after_a_damaged_file(board, salted, tmp_path):
    verify(board, "newcomer", salted[1], tmp_path / "private", threads=1)
    (tmp_path / "salt").write_text(salted[1].hex() + "\n")
    (tmp_path / "salt").chmod(0o600)
    hidden = tmp_path / "private" / "newcomer" / "v1" / "hidden"
    damaged = hidden / "forced_death" / "episodes" / f"{TASK}.jsonl.gz"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:50])
    first = reveal_salt(board.root, tmp_path / "salt")
    wrong = f"newcomer: hidden/forced_death/episodes/{TASK}.jsonl.gz"
    assert board.publish_rows(tmp_path / "private") == (1, [wrong])
    damaged.write_bytes(whole)
    assert reveal_salt(board.root, tmp_path / "salt") == first
    assert board.publish_rows(tmp_path / "private") == (2, [])


def a_billionth(row):
    row["return"] += 1e-9


def a_life(row):
    row["survival"], row["deaths"], row["death_list"], row["first_death"] = 1.0, 0, [], None


@pytest.mark.parametrize(("change", "field"), [(a_billionth, "return"), (a_life, "survival")])
def test_a_claim_that_is_a_little_untrue_is_caught(tmp_path, salted, rows, change, field):
    board = Board(tmp_path / "board")
    new_salt(board.root, tmp_path / "salt", "hipg-1")
    add(board, salted[2], claims=altered(rows, tmp_path / "claims", change))
    found = verify(
        board, "newcomer", read_salt(board.root, tmp_path / "salt"), tmp_path / "private", threads=1
    )
    assert (found.outcome, found.differing) == ("mismatch", 1)
    (difference,) = found.differences
    assert (difference.split, difference.task, difference.world) == ("standard", TASK, 4)
    assert field in difference.fields
    assert "world 4" in found.reasons[0]
    # no hidden world was spent on it
    (shown,) = read_board(board)
    assert (shown.status, shown.worlds) == ("mismatch", "public")
    assert not (shown.folder / "hidden").exists()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda row: row.pop("survival"), "survival is required and missing"),
        (lambda row: row.update({"return": "high"}), "return = 'high' is refused"),
        (lambda row: row.update({"return": float("nan")}), "is not JSON"),
        (lambda row: row.update(world=-1), "world = -1 is refused"),
        (lambda row: row.update(policy="another"), "belongs to another evaluation"),
        (lambda row: row.update(versions={}), "belongs to another evaluation"),
    ],
)
def test_claims_that_are_no_rows_are_refused_and_leave_nothing(tmp_path, salted, rows, change, message):
    board = Board(tmp_path / "board")
    claims = altered(rows, tmp_path / "claims", change)
    with pytest.raises((SpecError, ResumeError), match=message):
        add(board, salted[2], claims=claims)
    assert board.names() == ()
    assert not list(board.root.glob(".hipg-bench-draft*"))


def test_what_was_tampered_with_on_the_board_is_not_believed(board, salted, tmp_path):
    _, salt, _ = salted
    folder = board.folder("newcomer")
    path = folder / "standard" / "episodes" / f"{TASK}.jsonl.gz"
    text = unpack(path)
    row = parse_rows(text, "")[0]
    pack(text.replace(json.dumps(row["return"]).encode(), b"0.0"), path)
    with pytest.raises(BoardError, match="not what was entered"):
        read_board(board)[0].rows("public", "standard", TASK)
    assert verify(board, "newcomer", salt, tmp_path / "private", threads=1).outcome == "mismatch"
    bundle = folder / "bundle.zip"
    bundle.write_bytes(bundle.read_bytes() + b"\0")
    with pytest.raises(BoardError, match="not what was entered"):
        verify(board, "newcomer", salt, tmp_path / "private", threads=1)


def test_bundles_that_may_not_be_entries(tmp_path, board):
    fake = tmp_path / "fake"
    fake.mkdir()
    (fake / "agent.toml").write_text('name = "mine"\nsummary = "s"\nbuiltin = "scripted"\n')
    with pytest.raises(BundleError, match="come with the benchmark"):
        add(board, fake)
    with pytest.raises(BundleError, match="belongs to an agent of the benchmark"):
        add(board, network(tmp_path / "famous", "mappo_minhealth"))
    with pytest.raises(BoardError, match="has an entry 'newcomer' already"):
        add(board, network(tmp_path / "again"))


def test_replacing_keeps_the_earlier_version(board, tmp_path):
    entry = add(board, network(tmp_path / "newcomer"), SHORT, replace=True)
    assert entry.version == 2
    assert entry.verification is None
    assert (board.root / "history/newcomer/v1/forced_death/results.json").exists()


@pytest.mark.skipif(not SANDBOXED, reason="no sandbox works on this machine")
def test_code_of_others_is_verified_in_the_sandbox_and_sharing_is_listed(tmp_path, board, salted):
    _, salt, _ = salted
    alone = python(tmp_path / "alone", "alone", "np.tanh(observation[..., :3])")
    shares = python(tmp_path / "shares", "shares", "np.tanh(np.roll(observation[..., :3], 1, axis=1))")
    for folder, execution in ((alone, "decentralised"), (shares, "centralised")):
        entry = add(board, zipped(folder), SHORT)
        assert entry.sandbox == choice.sandbox()
        found = verify(board, folder.name, salt, tmp_path / "private", threads=1)
        assert (found.outcome, found.sandbox, found.execution) == ("verified", choice.sandbox(), execution)
    assert any("acted on more than they observed" in reason for reason in found.reasons)


class SharesAfterADeath:
    """Every agent acts on its own observation until a team-mate is dead, and then on another's."""

    privileged = False

    def initial_state(self, seed, episode_id, num_agents):
        return None

    def act(self, seen, memory, alive):
        shared = np.where(alive.all(axis=1)[:, None, None], seen, np.roll(seen, 1, axis=1))
        return 0.1 * np.tanh(shared[..., :3]), None


@pytest.mark.parametrize(
    ("splits", "execution"),
    [(("standard",), "decentralised"), (("standard", "forced_death"), "centralised")],
)
def test_sharing_is_found_in_every_split_that_counts(splits, execution):
    """Nobody dies on this task unless the split kills."""
    task = "coop_nav-3"
    played = {"tasks": [{"task": task}], "skipped": [], "episodes_per_policy": 6}
    view = Mock(spec=EntryView, results={("public", split): played for split in splits})
    view.entry = Mock(privileged=False, policies={task: {0: ""}})
    agent = Mock(spec=Agent, policy=lambda spec, seed: SharesAfterADeath())
    agent.card = Mock(execution="decentralised", tier=2)
    found, said = verifying._audit(agent, view, bytes(32), "key")
    assert found == execution
    assert all(reason.startswith("forced_death, coop_nav-3, training seed 0: centralised") for reason in said)


def test_trusted_code_is_never_verified(tmp_path, board, salted):
    folder = python(tmp_path / "trusted", "trusted", "observation[..., :3] * 0")
    assert add(board, folder, SHORT, trust=True).sandbox == "none"
    found = verify(board, "trusted", salted[1], tmp_path / "private", trust=True, threads=1)
    assert (found.outcome, found.sandbox) == ("unsandboxed", "none")
    shown = next(one for one in read_board(board) if one.name == "trusted")
    # its hidden scores are not shown as if they were worth something
    assert (shown.status, shown.worlds) == ("unsandboxed", "public")


def test_references_see_the_joint_state_and_have_no_rank(tmp_path):
    board = Board(tmp_path)
    entry = add(board, "scripted", SHORT)
    assert (entry.bundle, entry.tier, entry.privileged) == (None, None, True)
    assert read_board(board)[0].kind == "reference"


def command(*args):
    main = "from hipg_bench.cli import main; main()"
    return [sys.executable, "-c", main, "leaderboard", *map(str, args)]


OPTIONS = ("--tasks", TASK, "--splits", "standard", "--films", "none", "--threads", "1", "--board")


def test_the_commands_from_a_zip_to_a_page(tmp_path):
    """What docs/guides/leaderboard.md tells a maintainer, word by word."""
    board, package = tmp_path / "board", zipped(network(tmp_path / "newcomer"))

    def run(*args):
        return subprocess.run(command(*args), capture_output=True, text=True, timeout=120)

    salt = tmp_path / "safe" / "salt"
    assert "now promises" in run("salt", "new", salt, "--board", board).stdout
    added = run("add", package, "--episodes", 3, *OPTIONS, board)
    assert "newcomer is on the board, self-reported" in added.stdout, added.stderr
    again = run("add", package, "--episodes", 3, *OPTIONS, board)
    assert (again.returncode, again.stdout) == (2, "")
    assert "has an entry 'newcomer' already" in again.stderr
    assert "Traceback" not in again.stderr
    checked = run("verify", "newcomer", "--salt-file", salt, "--board", board)
    if FROZEN:
        assert checked.returncode == 0, checked.stderr
        assert "newcomer: verified, decentralised, sandbox not needed" in checked.stdout
    else:
        assert checked.returncode == 2
        assert "the tree is not hipg-1" in checked.stderr
    assert run("build", "--out", tmp_path / "site", "--board", board).returncode == 0
    assert "newcomer" in (tmp_path / "site" / "index.html").read_text()
    typo = run("verify", "newcommer", "--salt-file", salt, "--board", board)
    assert typo.returncode == 2
    assert "did you mean 'newcomer'?" in typo.stderr


def test_adding_is_killed_and_two_add_at_once(tmp_path):
    board = Board(tmp_path / "board")
    packages = [zipped(network(tmp_path / name, name)) for name in ("one", "two")]
    long = subprocess.Popen(
        command("add", packages[0], "--episodes", 3000, *OPTIONS, board.root), stderr=subprocess.DEVNULL
    )
    until = time.monotonic() + 60
    while not list(board.root.glob(".hipg-bench-draft-one-*/.work/standard/episodes/*.jsonl")):
        assert long.poll() is None
        assert time.monotonic() < until
        time.sleep(0.02)
    os.kill(long.pid, signal.SIGKILL)
    long.wait()
    assert board.names() == ()
    children = [
        subprocess.Popen(command("add", package, "--episodes", 3, *OPTIONS, board.root))
        for package in packages
    ]
    assert [child.wait(120) for child in children] == [0, 0]
    assert board.names() == ("one", "two")
    assert not list(board.root.glob(".hipg-bench-draft*"))
    assert load_agent("zero").name not in board.names()


@pytest.mark.parametrize(
    ("curve", "weights", "kept"),
    [
        ("steps,return,eval_return\n1,150,\n2,160,70\n3,170,80\n", {"alive": 0.1}, [(2, 70), (3, 80)]),
        ("steps,return\n1,150\n2,160\n", {"alive": 0.1}, None),
        ("steps,return\n1,50\n2,60\n", {}, [(1, 50), (2, 60)]),
        ("steps,return\n1,50\n2,60\n", None, [(1, 50), (2, 60)]),
    ],
)
def test_returns_with_weights_of_training_are_no_curve(curve, weights, kept, tmp_path):
    """They are not on the scale of the task's reference, which stands in the same chart."""
    place = tmp_path / "agent" / TASK
    place.mkdir(parents=True)
    (place / "seed0.curve.csv").write_text(curve)
    if weights is not None:
        (place / "seed0.json").write_text(json.dumps({"settings": {"weights": weights}}))
    weights_file = data_folder("agents") / "mappo_minhealth" / TASK / "seed0.safetensors"
    shutil.copyfile(weights_file, place / "seed0.safetensors")
    (tmp_path / "agent" / "agent.toml").write_text(
        'name = "agent"\nsummary = "s"\nkind = "network"\nsuite = "hipg-1"\n'
    )
    adding._copy_curves(load_agent(tmp_path / "agent"), tmp_path / "entry")
    written = tmp_path / "entry" / "curves" / TASK / "seed0.csv"
    assert written.exists() == (kept is not None)
    if kept:
        rows = [tuple(map(float, line.split(","))) for line in written.read_text().splitlines()[1:]]
        assert rows == kept
