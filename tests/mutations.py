"""Mutations of what strangers hand over, for `test_fuzz`; all chance comes from a generator that is given."""

from __future__ import annotations

import json
import random
import zipfile
from collections.abc import Callable
from pathlib import Path

JUNK = (
    "", " ", "0", "-1", "1e308", "nan", "inf", "null", "true", "[]", "{}", '""', "[/x]", "[bold]", "\x00",
    "\x1b[31m", "\u202e", "../../x", "/etc/passwd", "a" * 300, "9" * 5000, "[" * 3000, "{" * 3000,
    '"', "\\", "é", "😀", "\ufeff", "99999999999999999999", "-0.0", "1979-05-27", "<script>", "=1+1",
    "%s", "hazard_nav-4",
)  # fmt: skip
"""Values that were trouble somewhere."""


def damaged(content: bytes, chance: random.Random) -> bytes:
    """Bytes with something cut, doubled, turned over or replaced."""
    data = bytearray(content)
    for _ in range(chance.choice((1, 1, 2, 5))):
        at = chance.randrange(len(data) + 1)
        kind = chance.randrange(6)
        if kind == 0:
            del data[at:]
        elif kind == 1 and data:
            data[at % len(data)] ^= 1 << chance.randrange(8)
        elif kind == 2:
            data[at:at] = chance.choice(JUNK).encode("utf-8", "surrogatepass")
        elif kind == 3:
            data[at : at + chance.randrange(1, 30)] = b""
        elif kind == 4:
            data[at:at] = data[at : at + chance.randrange(1, 200)]
        else:
            data[at:at] = bytes(chance.randrange(256) for _ in range(chance.randrange(1, 8)))
    return bytes(data)


def mutated_text(text: str, chance: random.Random) -> bytes:
    """A TOML or CSV file with a value, a line or some bytes changed."""
    lines = text.splitlines()
    for _ in range(chance.choice((1, 1, 2))):
        at, kind = chance.randrange(len(lines)), chance.randrange(5)
        if kind == 0 and "=" in lines[at]:
            lines[at] = f"{lines[at].split('=')[0]}= {chance.choice(JUNK)}"
        elif kind == 1:
            lines[at] = ",".join(chance.choice(JUNK) for _ in range(chance.randrange(1, 5)))
        elif kind == 2:
            lines.insert(at, lines[at])
        elif kind == 3 and len(lines) > 1:
            lines.pop(at)
        else:
            return damaged("\n".join(lines).encode("utf-8", "surrogatepass"), chance)
    return "\n".join(lines).encode("utf-8", "surrogatepass")


def mutated_row(line: str, chance: random.Random) -> bytes:
    """A row with a field changed, missing or new."""
    row = json.loads(line)
    values = (None, True, -1, 2**60, 10**400, 1e308, "x", [], {}, [1], {"a": 1}, "[/x]", 0.5, -0.0, "é" * 200)
    for _ in range(chance.choice((1, 1, 2))):
        name, kind = chance.choice(sorted(row)), chance.randrange(4)
        if kind == 0 and len(row) > 1:
            del row[name]
        elif kind == 1:
            row[chance.choice(JUNK)] = chance.choice(values)
        else:
            row[name] = chance.choice(values)
    text = json.dumps(row).encode()
    return damaged(text, chance) if chance.random() < 0.2 else text


def mutated_zip(content: bytes, chance: random.Random, place: Path) -> bytes:
    """An archive with a damaged byte, or with an entry that should not be there."""
    if chance.random() < 0.6:
        return damaged(content, chance)
    path = place / "made.zip"
    path.write_bytes(content)
    with zipfile.ZipFile(path, "a") as archive:
        name = chance.choice(
            ("../../outside", "/tmp/outside", "agent.toml", "a\\b", "x" * 200, "é.py", "con.json", "")
        )
        archive.writestr(name or "empty/", chance.choice(JUNK).encode("utf-8", "surrogatepass"))
    return path.read_bytes()


def command_lines(place: Path) -> tuple[str, ...]:
    """Commands that end at once, whatever is done to their words; they may write below ``place`` only."""
    return (
        f"evaluate --agent zero --tasks hazard_nav-4 --episodes 1 --video 0 --threads 1 --out {place}/e",
        f"compare {place}/e {place}/e",
        f"export {place}/e --out {place}/x.json",
        f"train --task hazard_nav-4 --steps 1 --set num_envs=1 --set rollout=2 --out {place}/t",
        "tasks show hazard_nav-4 --json",
        "agents show zero",
        f"submit init {place}/agent --tier 0 --authors A --license MIT --summary s",
        f"submit check {place}/agent",
        f"submit pack {place}/agent -o {place}/agent.zip",
        f"leaderboard build --board {place}/board --out {place}/site",
        f"leaderboard salt new {place}/salt --board {place}/board",
        f"video --task hazard_nav-4 --agent zero --out {place}/film.bin --width 64 --height 64 --fps 1",
    )


def mutated_command(line: str, chance: random.Random) -> list[str]:
    """The words of a command, one of them replaced, added, dropped or moved."""
    words = line.split()
    for _ in range(chance.choice((1, 1, 2))):
        at, kind = chance.randrange(len(words)), chance.randrange(5)
        if kind <= 1 and at:
            words[at] = chance.choice(JUNK)
        elif kind == 2:
            words.insert(at, chance.choice(JUNK))
        elif kind == 3 and len(words) > 1:
            words.pop(at)
        else:
            words[at], words[-1] = words[-1], words[at]
    # whatever it became, it writes where it may
    unsafe = {"--trust", "serve", "view", "bench", "refresh", "--write", "doctor"}
    return [word for word in words if word not in unsafe]


Mutation = Callable[[random.Random], bytes]
