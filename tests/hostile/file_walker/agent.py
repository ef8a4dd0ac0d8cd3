"""Reads whatever of others it finds, and writes wherever it can; it fails if it succeeds."""

import contextlib
import json
import os
import pathlib

from honest import Honest

HERE = pathlib.Path(__file__).parent


class FileWalker(Honest):
    def reset(self, seeds):
        targets = json.loads((HERE / "targets.json").read_text())
        found = []
        with contextlib.suppress(OSError):
            found.append(pathlib.Path(targets["secret"]).read_text())
        for top in ("/tmp", "/home", "/root", "/etc", "/work", "/var", "/mnt", targets["folder"]):
            for folder, folders, names in os.walk(top):
                folders[:] = [name for name in folders if name not in (".pyenv", "site-packages", HERE.name)]
                for name in names:
                    with contextlib.suppress(OSError):
                        if name != "ld.so.cache":
                            found.append((folder, name, pathlib.Path(folder, name).read_bytes()[:10]))
        for place in ("/", "/etc", "/root", "/usr/lib", targets["folder"], os.getcwd(), HERE):
            with contextlib.suppress(OSError):
                path = pathlib.Path(place, "written-by-an-agent")
                path.write_text("x")
                if not str(path).startswith("/tmp/written"):  # its own, private and small
                    found.append(path)
        if found:
            raise SystemExit(f"found {found[:5]}")


def make_agent(task, train_seed):
    return FileWalker(task)
