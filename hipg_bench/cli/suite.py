"""``hipg-bench suite``: the frozen suite version."""

from __future__ import annotations

from typing import Annotated

import typer

from hipg_bench.cli import console

app = typer.Typer(help="Check that this checkout matches the frozen benchmark version.")


@app.command()
def check(as_json: Annotated[bool, typer.Option("--json", help="For scripts.")] = False) -> None:
    """Compare this checkout with the frozen benchmark version. Exits with 1 if it differs."""
    from hipg_bench.evaluation import protocol

    differences = protocol.differences()
    if as_json:
        console.show_json(protocol.identity() | {"differences": differences})
    elif differences:
        console.say(f"the tree is not {protocol.SUITE}:")
        for line in differences:
            console.say(f"  {line}")
        console.say("\nif no behaviour changed (tests/test_golden.py passes): hipg-bench suite freeze")
    else:
        console.say(f"the tree is {protocol.SUITE} ({protocol.identity()['digest']})")
    if differences:
        raise typer.Exit(1)


@app.command()
def freeze() -> None:
    """Rewrite the frozen version after a change that leaves all episodes unchanged."""
    from hipg_bench.evaluation import protocol

    console.say(str(protocol.freeze()))
