"""Tables in narrow terminals: every word stays whole and every line within the width."""

import io
import re

import pytest
from rich.console import Console

from hipg_bench import registry
from hipg_bench.cli import console, tasks


class Terminal(io.StringIO):
    def isatty(self):
        return True


@pytest.fixture
def narrow(monkeypatch):
    """What was printed to a terminal of 60 columns, without its colours."""
    terminal = Terminal()
    monkeypatch.setattr(console, "out", Console(file=terminal, width=60, highlight=False))
    return lambda: re.sub(r"\x1b\[[0-9;]*m", "", terminal.getvalue())


def words(text):
    """Its words, without what stands between them."""
    return {word.strip(";,:") for word in text.split()}


def test_the_list_of_tasks_is_readable_in_60_columns(narrow):
    rows = console.table("task", "suite", ">agents", "")
    for spec in registry.tasks().values():
        rows.add_row(spec.task, ", ".join(spec.tags), str(spec.num_agents), spec.summary)
    console.show(rows)
    said = narrow()
    assert max(map(len, said.splitlines())) <= 60
    for spec in registry.tasks().values():
        assert words(f"{spec.task} {spec.summary}") <= words(said)


@pytest.mark.parametrize("task", ["hazard_nav-8", "multiwalker-5"])
def test_a_task_is_readable_in_60_columns(task, narrow):
    tasks.show(task)
    said = narrow()
    layout = registry.make(task).layout
    for block in layout.observation.blocks:
        assert words(f"{block.name} {block.visible}") <= words(said)
    body = said.splitlines()[1:]  # the head line is unbroken, as a shell's log wants it
    assert max(map(len, body)) <= 60


def test_wide_tables_stay_tables(narrow):
    rows = console.table("a", "b")
    rows.add_row("1", "two")
    console.show(rows)
    assert [line.rstrip() for line in narrow().splitlines()] == ["a  b", "1  two"]
