"""`verify`: a maintainer plays an entry again, compares with what it claims, and scores it on hidden worlds.

Agents whose code or graph comes from others play in the sandbox, from the packed submission as it was
entered. The salt stays in this process: the agent sees observations, and worlds' seeds are told to nobody.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections.abc import Sequence
from pathlib import Path

from hipg_bench import registry
from hipg_bench.errors import BoardError
from hipg_bench.evaluation import decentralised, machines, protocol
from hipg_bench.evaluation.episodes import versions
from hipg_bench.evaluation.seeds import SUITE, commitment
from hipg_bench.leaderboard.board import Board
from hipg_bench.leaderboard.entry import Difference, Entry, Execution, Outcome, Verification, now
from hipg_bench.leaderboard.entry_view import EntryView, read_entry_view
from hipg_bench.leaderboard.playing import BoardEvaluation, Progress, keep_hidden, limited, play, quiet
from hipg_bench.leaderboard.rows import compare, unpack
from hipg_bench.leaderboard.salt import read_commitments
from hipg_bench.leaderboard.source import Source, reopened
from hipg_bench.policies.bundle import Agent
from hipg_bench.sandbox import choice

_KEPT = 20
"""Differences that are written down."""


@dataclasses.dataclass(frozen=True)
class _Comparison:
    """What playing the public worlds again showed."""

    compared: int
    differences: Sequence[Difference]
    splits: Sequence[str]


def verify(
    board: Board,
    name: str,
    salt: bytes,
    private: Path,
    *,
    trust: bool = False,
    threads: int = 0,
    progress: Progress = quiet,
) -> Verification:
    """Check an entry, and write down what came of it; hidden worlds are played only if all rows are true.

    Args:
        board: where.
        name: which entry.
        salt: behind the hidden worlds.
        private: the host's own folder, where rows of hidden worlds stay until the salt is revealed.
        trust: run its code without a sandbox; it is ``unsandboxed`` then.
        threads: physics threads, 0 for all cores.
        progress: told how far it is.

    Raises:
        BoardError: the tree is not the frozen suite, this machine not one on which rows come out the same,
            the salt not the promised one, or the entry is damaged or changed meanwhile.
        UnknownNameError: no such entry.
    """
    folder, progress = board.folder(name), limited(progress)
    changed = protocol.differences()
    if changed:
        raise BoardError(f"the tree is not {SUITE}, so nothing is verified with it: {changed[0]}")
    differs = machines.why_rows_may_differ()
    if differs:
        raise BoardError(f"nothing is verified here: {differs}")
    promised = read_commitments(board.root).sha256
    if commitment(salt) != promised:
        raise BoardError(f"this salt is not the one that {board.root} is bound to")
    view = read_entry_view(folder, promised)
    date = now()
    agent_seed_key = f"{name}|{view.entry.version}|{date}"
    with (
        board.workspace("verify") as work,
        reopened(view.folder, view.entry, work, trust=trust) as source,
        board.draft(name, view.entry) as draft,
    ):
        shutil.copytree(view.folder, draft, dirs_exist_ok=True)
        shutil.rmtree(draft / "hidden", ignore_errors=True)
        rows = {path: digest for path, digest in view.entry.rows.items() if not path.startswith("hidden/")}
        seen = _compare(view, source.agent, work, threads, progress)
        execution, said = _audit(source.agent, view, salt, agent_seed_key)
        outcome, reasons = _outcome(view.entry, source, seen)
        if outcome != "mismatch":
            for split, evaluation in _evaluations(view, threads).items():
                run = play(source.agent, evaluation, split, work, salt, agent_seed_key, progress)
                rows |= keep_hidden(run, draft, private / name / f"v{view.entry.version}", split)
        found = Verification(
            date=date,
            outcome=outcome,
            commitment=commitment(salt),
            sandbox=source.sandbox,
            compared=seen.compared,
            differing=len(seen.differences),
            differences=tuple(seen.differences[:_KEPT]),
            execution=execution,
            reasons=(*reasons, *said),
            versions=versions(),
        )
        board.write(draft, view.entry.model_copy(update={"rows": rows, "verification": found}))
    return found


def _evaluations(view: EntryView, threads: int) -> dict[str, BoardEvaluation]:
    """What was played of each split when the entry was made."""
    return {
        split: BoardEvaluation(
            tasks=_in_order([one["task"] for one in (*result["tasks"], *result["skipped"])]),
            splits=(split,),
            episodes=result["episodes_per_policy"],
            threads=threads,
        )
        for (worlds, split), result in view.results.items()
        if worlds == "public"
    }


def _in_order(tasks: Sequence[str]) -> tuple[str, ...]:
    """Tasks as the suite orders them."""
    return tuple(task for task in registry.tasks() if task in tasks)


def _compare(view: EntryView, agent: Agent, work: Path, threads: int, progress: Progress) -> _Comparison:
    """Play the public worlds again, and compare row by row."""
    compared, differences = 0, list[Difference]()
    for split, evaluation in _evaluations(view, threads).items():
        run = play(agent, evaluation, split, work, progress=progress)
        ours = {path.stem: path.read_bytes() for path in (run / "episodes").glob("*.jsonl")}
        # every file that the entry lists, played by us or not
        theirs = {
            path.removeprefix(f"{split}/episodes/").removesuffix(".jsonl.gz"): unpack(view.folder / path)
            for path in view.entry.rows
            if path.startswith(f"{split}/")
        }
        for task in sorted({*ours, *theirs}):
            differences += compare(split, task, theirs.get(task, b""), ours.get(task, b""))
            compared += ours.get(task, b"").count(b"\n")
    return _Comparison(compared, differences, tuple(_evaluations(view, threads)))


def _audit(
    agent: Agent, view: EntryView, salt: bytes, agent_seed_key: str
) -> tuple[Execution, tuple[str, ...]]:
    """Whether each agent acts on what it sees alone: so by construction, or by replay of code of others."""
    if view.entry.privileged or agent.card.execution == "centralised":
        return "centralised", ()
    if agent.card.tier != 2:
        return "decentralised", ()
    for split, evaluation in _evaluations(view, threads=1).items():
        job = evaluation.job(split, salt, agent_seed_key)
        worlds = next(job.batches())
        for task, seeds in view.entry.policies.items():
            spec = registry.task_spec(task)
            for seed in seeds:
                verdict = decentralised.verify(spec, agent.policy(spec, seed), job, worlds)
                if not verdict.decentralised:
                    return "centralised", (f"{split}, {task}, training seed {seed}: {verdict}",)
    return "decentralised", ()


def _outcome(entry: Entry, source: Source, seen: _Comparison) -> tuple[Outcome, tuple[str, ...]]:
    """The badge, and why it is not the best one."""
    agent = source.agent
    compared = ("hidden/", *(f"{split}/" for split in seen.splits))
    reasons = [
        f"{path}: rows of a split that has no results" for path in entry.rows if not path.startswith(compared)
    ]
    for task, seeds in entry.policies.items():
        if {seed: agent.fingerprint(task, seed) for seed in agent.train_seeds(task)} != seeds:
            reasons.append(f"{task}: the policies are not those that were entered")
    if seen.differences:
        first = seen.differences[0]
        where = f"{first.split}, {first.task}, seed {first.train_seed}, world {first.world}"
        reasons.append(f"{len(seen.differences)} of {seen.compared} rows differ, first {where}: {first.what}")
    if reasons:
        return "mismatch", tuple(reasons)
    if source.sandbox == choice.NONE:
        return "unsandboxed", ("it was trusted with the machine while it played",)
    return "verified", ()
