"""Progress where the error stream is no terminal: plain lines, now and then."""

import re
import time

from hipg_bench.cli import console


def test_a_log_gets_a_line_now_and_then(monkeypatch, capsys):
    monkeypatch.setattr(console, "PLAIN_SECONDS", 0.05)
    monkeypatch.setattr(console.err, "file", None)  # what pytest captures now
    with console.progress() as bars:
        bars.add_task("waiting", total=4)
        bar = bars.add_task("films", total=4)
        bars.advance(bar)
        said = ""
        until = time.monotonic() + 20
        while "films" not in said and time.monotonic() < until:
            time.sleep(0.02)
            said += capsys.readouterr().err
    assert re.search(r"^films: 25 % after \d+ s", said, re.MULTILINE)
    assert "waiting" not in said
    capsys.readouterr()
    time.sleep(0.2)
    assert capsys.readouterr().err == ""


def test_short_work_is_silent(capsys):
    with console.progress() as bars:
        bars.advance(bars.add_task("films", total=4))
    assert capsys.readouterr().err == ""
