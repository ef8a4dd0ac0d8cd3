"""The schema of rows, wherever they are read again: to resume, from a submitter, on the board."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, cast

import pydantic

from hipg_bench.errors import SpecError
from hipg_bench.evaluation import splits
from hipg_bench.evaluation.episodes import Row
from hipg_bench.evaluation.failures import NOT_PLAYED
from hipg_bench.evaluation.seeds import WORLDS_PER_SEED
from hipg_bench.registry import definition_of
from hipg_bench.spec import Params, TaskSpec, parse

_MOST = 2**53
"""Whole numbers above are not the same in every reader of JSON."""
_SHOWN = 60
"""Characters of a line that a message shows."""

_Name = Annotated[str, pydantic.Field(max_length=100)]
_Count = Annotated[int, pydantic.Field(strict=True, ge=0, le=_MOST)]
_Number = Annotated[float, pydantic.Field(strict=True, ge=-1e12, le=1e12)]
_Time = Annotated[float, pydantic.Field(strict=True, ge=0, le=1e9)]
_Share = Annotated[float, pydantic.Field(strict=True, ge=0, le=1)]


class _Death(Params):
    agent: _Count
    time: _Time
    cause: _Name


class _RowModel(Params):
    """The fields of ``docs/concepts/protocol.md``, with their ranges."""

    task: _Name
    version: _Count
    fingerprint: _Name
    agent: _Name
    policy: _Name
    train_seed: _Count
    versions: dict[_Name, _Name]
    split: _Name
    world: _Count
    eval_seed: _Count | None
    episode_id: _Count
    variant: _Count | None
    status: Literal["ok", "crash", "timeout", "not_finite", "wrong_shape", "not_played"]
    returned: _Number = pydantic.Field(alias="return")
    reached: _Number | None
    score: _Number | None
    length: _Count | None
    end_reason: _Name
    survival: _Share | None
    deaths: _Count | None
    first_death: _Time | None
    death_list: tuple[_Death, ...] = pydantic.Field(max_length=1000)
    others: tuple[_Count, ...] = pydantic.Field(max_length=1000)
    metrics: dict[_Name, _Number | None]


def read_rows(text: bytes, where: str, spec: TaskSpec) -> list[Row]:
    """Parse a file of rows.

    Args:
        text: a JSON object per line.
        where: the file, for errors.
        spec: the task that they must be of.

    Raises:
        SpecError: a line is no row: a field is missing, unknown, of another type or out of its range, or does
            not fit the others; or two rows are of the same training seed and world.
    """
    rows: list[Row] = []
    seen: set[tuple[int, int]] = set()
    for number, line in enumerate(text.splitlines(), start=1):
        row = _read(line, f"{where}: line {number}", spec)
        key = (row["train_seed"], row["world"])
        if key in seen:
            raise SpecError(
                f"{where}: line {number}: training seed {key[0]} has a second row of world {key[1]}"
            )
        seen.add(key)
        rows.append(row)
    return rows


def _read(line: bytes, where: str, spec: TaskSpec) -> Row:
    try:
        row = json.loads(line.decode("utf-8"), parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise SpecError(f"{where} is not JSON: {line[:_SHOWN]!r}") from error
    if not isinstance(row, dict):
        raise SpecError(f"{where} is no row: {line[:_SHOWN]!r}")
    row = cast(Row, row)
    parse(_RowModel, row, where)
    _check_agreement(row, where, spec)
    return row


def _refuse(constant: str) -> Any:
    raise ValueError(f"{constant} is not allowed")


def _check_agreement(row: Row, where: str, spec: TaskSpec) -> None:
    """Refuse fields that contradict each other or the task."""
    bodies, steps, metrics = spec.num_agents, spec.horizon, sorted(definition_of(spec).metrics)
    agents = [death["agent"] for death in row["death_list"]]
    wrong = {
        f"task = {row['task']!r} in a file of {spec.task}": row["task"] != spec.task,
        f"split = {row['split']!r}": row["split"] not in splits.SPLITS,
        f"episode_id = {row['episode_id']} of world {row['world']}": row["episode_id"]
        != row["world"] % WORLDS_PER_SEED,
        f"length = {row['length']}, above the horizon {steps},": (row["length"] or 0) > steps,
        f"an agent that is not below {bodies}": any(one >= bodies for one in (*agents, *row["others"])),
        "an agent that died twice": len(set(agents)) < len(agents),
        f"deaths = {row['deaths']}, above those of death_list,": (row["deaths"] or 0) > len(agents),
        f"metrics with the names {sorted(row['metrics'])[:9]}": sorted(row["metrics"]) != metrics,
        "a field that is null although the episode was played": row["status"] != NOT_PLAYED
        and None in (row["reached"], row["length"], row["deaths"]),
    }
    for what, is_so in wrong.items():
        if is_so:
            raise SpecError(f"{where}: {what} is refused")
