"""Looks for the salt of hidden worlds, whose hash is public, wherever it can; fails if it finds it."""

import contextlib
import gc
import hashlib
import json
import os
import pathlib
import sys

from honest import Honest

HERE = pathlib.Path(__file__).parent


def candidates(targets):
    """Whatever might be the salt."""
    yield from (value.encode() for value in os.environ.values())
    yield from (word.encode() for word in sys.argv)
    for process in ("self", "1", os.getppid(), targets["parent"]):
        for name in ("environ", "cmdline", "maps", "fd"):
            with contextlib.suppress(OSError):
                yield from pathlib.Path(f"/proc/{process}/{name}").read_bytes().split(b"\0")
        with contextlib.suppress(OSError):
            os.open(f"/proc/{process}/mem", os.O_RDONLY)
            raise SystemExit(f"opened the memory of {process}")
    for path in (
        targets["secret"],
        targets["folder"],
        "/run/secrets/salt",
        os.path.expanduser("~/.hipg/salt"),
    ):
        with contextlib.suppress(OSError):
            yield pathlib.Path(path).read_bytes()
    for descriptor in range(3, 64):
        with contextlib.suppress(OSError):
            os.lseek(descriptor, 0, 0)  # pipes refuse this; a file left open would not
            yield os.read(descriptor, 4096)
    for thing in gc.get_objects():
        if type(thing) is dict:
            yield from (value for value in list(thing.values()) if type(value) is bytes)


class SaltFinder(Honest):
    def reset(self, seeds):
        targets = json.loads((HERE / "targets.json").read_text())
        for candidate in candidates(targets):
            for text in (candidate, candidate.strip(), candidate.partition(b"=")[2]):
                if hashlib.sha256(text).hexdigest() == targets["commitment"]:
                    raise SystemExit("found the salt")


def make_agent(task, train_seed):
    return SaltFinder(task)
