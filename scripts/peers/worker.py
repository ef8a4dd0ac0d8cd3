"""A process for one contender: it says its settings, then runs for as long as each line of input says.

python scripts/peers/worker.py "VMAS simple_spread"
"""

from __future__ import annotations

import json
import os
import sys
import time

from contenders import CONTENDERS


def main(name: str) -> None:
    """Answer each line, seconds, with the steps done and the seconds they took, as JSON."""
    # libraries print, some from C; the answers keep the real standard output for themselves
    with os.fdopen(os.dup(1), "w") as answers:
        os.dup2(2, 1)
        contender = CONTENDERS[name]()
        contender.run()
        answers.write(json.dumps(contender.settings) + "\n")
        answers.flush()
        for line in sys.stdin:
            steps, started = 0, time.perf_counter()
            while (spent := time.perf_counter() - started) < float(line):
                steps += contender.run()
            answers.write(json.dumps({"steps": steps, "seconds": spent}) + "\n")
            answers.flush()


if __name__ == "__main__":
    main(sys.argv[1])
