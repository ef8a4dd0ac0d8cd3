"""``hipg-bench audit``."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hipg_bench.cli import console, outputs
from hipg_bench.errors import HipgError, SpecError

if TYPE_CHECKING:
    from hipg_bench.learning.audit import Audit, Comparison
    from hipg_bench.learning.gradient_noise import GradientNoise

_NOISE_WORLDS = 8
"""Episodes that the gradient's noise is measured on, per episode that states are taken from."""


def audit(
    run: Annotated[Path | None, typer.Option(help="Folder of a training run.")] = None,
    agent: Annotated[
        str | None, typer.Option(help="A bundled agent's name or a bundle's folder, instead of --run.")
    ] = None,
    task: Annotated[
        str | None, typer.Option(help="Task whose networks are audited; needed with --agent.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Training seed of the networks; used with --agent.")] = 0,
    worlds: Annotated[
        int,
        typer.Option(
            min=1, help="Episodes that states are sampled from. The gradient noise uses 8 times as many."
        ),
    ] = 32,
    moments: Annotated[int, typer.Option(min=1, help="Sampled states per episode.")] = 4,
    repeats: Annotated[int, typer.Option(min=2, help="Rollouts per state and removed agent.")] = 8,
    rollout_seed: Annotated[int, typer.Option(min=0, help="Random seed of the rollouts.")] = 500,
    threads: Annotated[int, typer.Option(min=1, help="Threads of PyTorch.")] = 1,
    plot: Annotated[Path | None, typer.Option(help="Write a calibration plot to this PNG file.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")] = False,
) -> None:
    """Compare a critic's counterfactual values with rollouts of forked worlds, and measure gradient noise."""
    import torch

    from hipg_bench.learning import audit as audits
    from hipg_bench.learning.gradient_noise import gradient_noise

    if plot is not None:
        outputs.check_free(plot, outputs.PICTURE)
    torch.set_num_threads(threads)
    source = _source(run, agent, task, seed)
    actor, critic, settings = audits.load(source)
    found = audits.audit(
        actor, critic, settings, worlds=worlds, moments=moments, repeats=repeats, seed=rollout_seed
    )
    noise = gradient_noise(actor, critic, settings, worlds=_NOISE_WORLDS * worlds, seed=rollout_seed)
    if plot is not None:
        audits.draw(found, plot, title=f"{settings.task}, {settings.algorithm}, seed {settings.seed}")
    if as_json:
        console.show_json(
            _facts(found)
            | {"gradient": dataclasses.asdict(noise), "run": str(source), "settings": settings.model_dump()}
        )
        return
    _print(found, f"{settings.task}, algorithm {settings.algorithm}, training seed {settings.seed}")
    _print_noise(noise)


def _source(run: Path | None, agent: str | None, task: str | None, seed: int) -> Path:
    """Where the networks lie."""
    if (run is None) == (agent is None) or (agent is None) != (task is None):
        raise SpecError("audit takes either --run, or --agent and --task")
    if run is not None:
        return run
    from hipg_bench.policies.bundle import load_agent

    who = load_agent(str(agent))
    path = who.folder / str(task) / f"seed{seed}.learner.safetensors"
    if not path.is_file():
        there = sorted(str(one.relative_to(who.folder)) for one in who.folder.glob("*/*.learner.safetensors"))
        raise HipgError(
            f"agent {who.name!r} has no critic for {task}, training seed {seed}; "
            f"there are: {', '.join(there) or 'none'}"
        )
    return path


def _print(found: Audit, title: str) -> None:
    rows = console.table(
        "learned",
        ">mean",
        ">true mean",
        ">bias",
        ">error",
        ">correlation",
        ">noise of truth",
        "",
        title=title,
    )
    for name, about in (
        ("value", "V(s)"),
        ("counterfactual", "V(s with only h_i := 0)"),
        ("credit", "the difference: what agent i's life is worth"),
    ):
        one: Comparison = getattr(found, name)
        numbers = (one.learned.mean(), one.true.mean(), one.bias, one.error, one.correlation, one.noise)
        rows.add_row(name, *(console.number(float(value), 3) for value in numbers), about)
    console.show(rows)
    shares = ", ".join(f"{k} dead {share:.1%}" for k, share in enumerate(found.dead_share) if share >= 0.0005)
    console.say(
        f"{found.cases} pairs of a state and an agent, {found.repeats} rollouts each; "
        f"visited states: {shares}"
    )


def _print_noise(found: GradientNoise) -> None:
    rows = console.table(
        "baseline",
        ">noise of the gradient",
        ">95 % interval",
        "",
        title="The actor's gradient, V(s)'s noise = 1",
    )
    for name, about in (
        ("none", "the mean target alone"),
        ("central", "V(s)"),
        ("min_health", "V(s with only h_i := 0)"),
    ):
        low, high = found.interval[name]
        rows.add_row(name, console.number(found.noise[name], 3), f"{low:.2f} to {high:.2f}", about)
    console.show(rows)
    scale = "unknown" if found.scale is None else f"{found.scale:,.0f}"
    console.say(f"{found.episodes} episodes; noise scale (episodes) with the baseline V(s): {scale}")


def _facts(found: Audit) -> dict[str, object]:
    compared = {
        name: {
            "learned_mean": float(one.learned.mean()),
            "true_mean": float(one.true.mean()),
            "bias": one.bias,
            "error": one.error,
            "correlation": one.correlation,
            "noise": one.noise,
        }
        for name in ("value", "counterfactual", "credit")
        for one in (getattr(found, name),)
    }
    return {
        **compared,
        "dead_share": found.dead_share.tolist(),
        "cases": found.cases,
        "repeats": found.repeats,
    }
