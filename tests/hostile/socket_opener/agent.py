"""Calls home, over every protocol; it fails if it succeeds."""

import contextlib
import json
import pathlib
import socket

from honest import Honest


class SocketOpener(Honest):
    def reset(self, seeds):
        targets = json.loads((pathlib.Path(__file__).parent / "targets.json").read_text())
        for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM):
            for host in ("127.0.0.1", "0.0.0.0", "8.8.8.8"):
                with contextlib.suppress(OSError), socket.socket(socket.AF_INET, kind) as line:
                    line.settimeout(0.2)
                    line.connect((host, targets["tcp" if kind == socket.SOCK_STREAM else "udp"]))
                    line.send(b"the observations")
                    raise SystemExit(f"connected to {host}")


def make_agent(task, train_seed):
    return SocketOpener(task)
