"""Claims on folders: one process at a time, dead ones give way at once, silent ones after the lease."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

import hipg_bench
from hipg_bench import claims
from hipg_bench.claims import CLAIM, Claim, HeldError, claimed, owner
from hipg_bench.errors import ResumeError

ROOT = Path(hipg_bench.__file__).resolve().parents[1]
ENVIRONMENT = os.environ | {"PYTHONPATH": str(ROOT)}

HOLD = """
import sys, time
from pathlib import Path
from hipg_bench.claims import Claim
claim = Claim(Path(sys.argv[1]))
print(claim.take(), flush=True)
time.sleep(600)
"""

WORK = """
# works in one of the folders at a time, again and again, and tells where it was not alone
import os, random, sys, time
from pathlib import Path
from hipg_bench.claims import Claim
folders, chance = [Path(name) for name in sys.argv[2:]], random.Random(os.getpid())
while True:
    folder = chance.choice(folders)
    claim = Claim(folder)
    if not claim.take():
        continue
    busy = folder / "busy"
    try:
        other = int(busy.read_text())
        if Path(f"/proc/{other}/stat").read_text().rpartition(") ")[2][0] not in "ZX":  # dead, not yet buried
            Path(sys.argv[1], f"{os.getpid()}-{other}").touch()
    except (FileNotFoundError, ProcessLookupError, ValueError):
        pass
    busy.write_text(str(os.getpid()))
    time.sleep(chance.uniform(0, 0.01))
    if busy.read_text() != str(os.getpid()):
        Path(sys.argv[1], f"{os.getpid()}-overwritten").touch()
    busy.unlink()
    with (folder / "count").open("a") as file:
        file.write("x")
    claim.release()
"""


def start(code: str, *arguments: object) -> subprocess.Popen:
    command = [sys.executable, "-c", code, *(str(argument) for argument in arguments)]
    return subprocess.Popen(command, env=ENVIRONMENT, stdout=subprocess.PIPE, text=True)


def kill(process: subprocess.Popen) -> None:
    process.send_signal(signal.SIGKILL)
    process.communicate()


def foreign(folder: Path) -> None:
    """Turn a claim into one of a machine that nobody can ask."""
    (path,) = folder.glob(f"{CLAIM}*")
    path.write_text(json.dumps(json.loads(path.read_text()) | {"host": "elsewhere"}))


def test_a_held_folder_is_refused_with_its_owner_and_a_dead_ones_is_free(tmp_path: Path) -> None:
    holder = start(HOLD, tmp_path)
    assert holder.stdout is not None
    assert holder.stdout.readline() == "True\n"
    found = owner(tmp_path)
    assert found is not None
    assert (found.pid, found.alive) == (holder.pid, True)
    with (
        pytest.raises(HeldError, match=f"another process is training here .process {holder.pid} on"),
        claimed(tmp_path, "training"),
    ):
        pass
    kill(holder)
    with claimed(tmp_path, "training"):
        found = owner(tmp_path)
        assert found is not None
        assert found.pid == os.getpid()
    assert owner(tmp_path) is None
    assert len(list(tmp_path.iterdir())) == 1, "one small file stays"


def test_a_silent_claim_of_another_machine_is_taken_over_after_the_lease(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(claims, "LEASE", 1.5)
    ours, theirs = Claim(tmp_path), Claim(tmp_path)
    assert theirs.take()
    foreign(tmp_path)
    began = time.monotonic()
    while time.monotonic() < began + 3:  # twice the lease; it is renewed all the time
        assert not ours.take()
        time.sleep(0.1)
    theirs._stop.set()  # the machine is gone
    began = time.monotonic()
    while not ours.take():
        assert time.monotonic() < began + 20
        time.sleep(0.1)
    assert time.monotonic() > began + 0.9, "not before the lease is over, one renewal before"
    ours.check()
    with pytest.raises(ResumeError, match="has taken the folder over"):
        theirs.check()
    theirs.release()
    ours.check()  # which the loser's release leaves alone


def stress(tmp_path: Path, kills: int, pause: float) -> None:
    folders = [tmp_path / f"run{k}" for k in range(3)]
    (tmp_path / "overlaps").mkdir()
    chance = random.Random(3)
    workers = [start(WORK, tmp_path / "overlaps", *folders) for _ in range(8)]
    try:
        until = time.monotonic() + 60
        while not all((folder / "count").exists() for folder in folders):
            assert time.monotonic() < until
            time.sleep(0.05)
        for _ in range(kills):
            time.sleep(chance.uniform(0, pause))
            k = chance.randrange(len(workers))
            kill(workers[k])
            workers[k] = start(WORK, tmp_path / "overlaps", *folders)
        for folder in folders:  # nobody is locked out by the dead
            before = (folder / "count").stat().st_size
            until = time.monotonic() + 60
            while (folder / "count").stat().st_size == before:
                assert time.monotonic() < until
                time.sleep(0.05)
        assert all(worker.poll() is None for worker in workers)
    finally:
        for worker in workers:
            kill(worker)
    assert list((tmp_path / "overlaps").iterdir()) == []


def test_eight_processes_killed_at_random_never_work_in_one_folder(tmp_path: Path) -> None:
    stress(tmp_path, kills=12, pause=0.3)


@pytest.mark.long
def test_eight_processes_killed_three_hundred_times(tmp_path: Path) -> None:
    stress(tmp_path, kills=300, pause=0.5)
