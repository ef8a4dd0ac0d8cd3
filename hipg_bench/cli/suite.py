"""``hipg-bench suite``: the frozen suite version."""

from __future__ import annotations

from typing import Annotated

import typer

from hipg_bench.cli import console

app = typer.Typer(help="The suite version that scores refer to: is the tree what was frozen?")


@app.command()
def check(as_json: Annotated[bool, typer.Option("--json", help="For scripts.")] = False) -> None:
    """Compare the tree with the frozen suite version; exit code 1 where it differs."""
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
    """Write the suite file anew, after a change that leaves every episode as it was."""
    from hipg_bench.evaluation import protocol

    console.say(str(protocol.freeze()))
