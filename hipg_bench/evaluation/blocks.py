"""Blocks: the parts of an evaluation that many processes and machines play into one folder.

A block is the worlds of one evaluation seed, played by one policy. It has a folder of its own in
``<out>/blocks``, which the process that plays it claims, and its rows appear there whole. `runner.evaluate`
takes them over, plays what is missing, and writes what it always writes; then the blocks are removed.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from hipg_bench.claims import claimed
from hipg_bench.documents import read_json
from hipg_bench.errors import ResumeError, SpecError
from hipg_bench.evaluation.episodes import EvaluationJob, Row
from hipg_bench.evaluation.failures import OK, failures_of_a_dnf
from hipg_bench.evaluation.seeds import WORLDS_PER_SEED
from hipg_bench.launchers import Job, stop_when_orphaned
from hipg_bench.paths import remove_partial, write_text
from hipg_bench.policies.policy import Policy
from hipg_bench.spec import TaskSpec

FOLDER = "blocks"
"""The folder of blocks in an evaluation's."""
ROWS = "rows.jsonl"
"""The rows of a block in its folder."""
RECORD = "run.json"
"""The file that says which evaluation a folder is of: in a block's, and in the evaluation's own."""


class Block(NamedTuple):
    """One part of an evaluation.

    Attributes:
        agent: name or path of who plays.
        spec: the task, with the split's anchors.
        identity: what the rows say of the task, the policy and the versions.
        number: which evaluation seed, from 0.
        out: the evaluation's folder.
        job: the worlds of the whole evaluation.
        run: what the evaluation's ``run.json`` says.
    """

    agent: str
    spec: TaskSpec
    identity: Row
    number: int
    out: Path
    job: EvaluationJob
    run: dict[str, Any]

    @property
    def worlds(self) -> list[int]:
        """Its worlds."""
        first = self.number * WORLDS_PER_SEED
        return list(range(first, min(first + WORLDS_PER_SEED, self.job.episodes)))

    @property
    def folder(self) -> Path:
        """Where its rows are written."""
        worlds, seed = self.worlds, self.identity["train_seed"]
        return self.out / FOLDER / f"{self.spec.task}-seed{seed}-worlds{worlds[0]}-{worlds[-1]}"

    @property
    def finished(self) -> bool:
        """Whether its rows are written, here or among those of the evaluation."""
        if (self.folder / ROWS).exists():
            return True
        merged = self.out / "episodes" / f"{self.spec.task}.jsonl"
        if not merged.exists():
            return False
        rows = [json.loads(line) for line in merged.read_bytes().splitlines()]
        seed = self.identity["train_seed"]
        return {row["world"] for row in rows if row["train_seed"] == seed} >= set(self.worlds)

    def launcher_job(self) -> Job:
        """The block for a launcher."""
        return Job(self.folder, play, (self,))


def play(block: Block) -> None:
    """Play a block whose rows are not there yet.

    Raises:
        HeldError: another process plays it.
        ResumeError: the folder belongs to another evaluation: of another agent, suite or engine version.
    """
    # only who plays blocks needs to know how agents are found
    from hipg_bench.policies.trained import find_agent

    check_record(block.out / RECORD, block.run)
    with claimed(block.folder, "evaluating") as claim:
        if block.finished:
            return
        remove_partial(block.folder)
        agent, spec = find_agent(block.agent), block.spec
        seed = block.identity["train_seed"]
        if agent.fingerprint(spec.task, seed) != block.identity["policy"]:
            raise ResumeError(f"{block.agent}: its policy for {spec.task} is another one than at the start")
        others = set(range(block.job.episodes)) - set(block.worlds)
        played = block.job.rows(
            spec,
            agent.policy(spec, seed),
            [{"world": world, "status": OK} for world in others],
            lambda _: stop_when_orphaned(),
        )
        rows = [block.identity | row for batch in played for row in batch]
        claim.check()
        write_text(block.folder / RECORD, json.dumps(block.run, indent=2) + "\n")
        text = "".join(json.dumps(row, allow_nan=False) + "\n" for row in rows)
        write_text(block.folder / ROWS, text, sealed=True)


def check_record(path: Path, run: Mapping[str, Any]) -> None:
    """See that a folder, by its ``run.json``, is of this evaluation.

    Raises:
        ResumeError: it is of another agent, suite, engine version or of other worlds, or the file is damaged.
    """
    try:
        earlier = read_json(path)
    except SpecError as error:
        raise ResumeError(f"{path.name} is damaged: {error}; choose another --out") from error
    for name, value in run.items():
        if earlier.get(name) != value:
            raise foreign(path, name, earlier.get(name), value)


def foreign(path: Path, name: str, got: object, expected: object) -> ResumeError:
    """What is raised where a file is of another evaluation."""
    return ResumeError(
        f"{path} belongs to another evaluation: {name} is {got!r} there and {expected!r} here; "
        f"choose another --out"
    )


def cut_after_dnf(spec: TaskSpec, policy: Policy, rows: list[Row], job: EvaluationJob) -> list[Row]:
    """Rows of one policy as if the worlds had been played in order: after a DNF the rest is not played."""
    left, kept = failures_of_a_dnf(job.episodes), list[Row]()
    for row in sorted(rows, key=lambda row: row["world"]):
        kept.append(row if left > 0 else row | job.play(spec, policy, [row["world"]], failures=0)[0])
        left -= row["status"] != OK
    return kept
