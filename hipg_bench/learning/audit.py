"""How right a learned counterfactual is: V(s with agent i dead) against worlds in which agent i is dead.

The min-health baseline asks the critic about states that training hardly visits. State rows make the
true answer measurable: fork a world, kill agent i in the fork, let the same policy finish the episode
many times with fresh random numbers, and average the discounted returns.

Value targets bootstrap at the horizon (`Settings.bootstrap_truncation`), so that what the critic has
learned goes on beyond it; then the true worlds do so too, until what follows is discounted to 1 %.
"""

from __future__ import annotations

import dataclasses
import json
import math
from pathlib import Path

import numpy as np
import safetensors
import torch
from jaxtyping import Float
from matplotlib.figure import Figure
from torch import Tensor

from hipg_bench.env import BatchEnv
from hipg_bench.errors import HipgError
from hipg_bench.learning import checkpoint
from hipg_bench.learning.credit.min_health import with_each_dead
from hipg_bench.learning.critics import StateCritic
from hipg_bench.learning.mappo import networks
from hipg_bench.learning.networks import Actor, Critic
from hipg_bench.learning.settings import Settings
from hipg_bench.paths import replacing
from hipg_bench.registry import definition_of, make, task_spec
from hipg_bench.spec import parse

_MOST_WORLDS = 2048
"""Worlds that are rolled out side by side."""
_NEGLIGIBLE = 0.01
"""Discount at which what follows is left out."""


@dataclasses.dataclass(frozen=True)
class Comparison:
    """A learned quantity beside its true value, over K cases.

    Attributes:
        learned: (K,) what the critic says, in units of reward.
        true: (K,) mean discounted return of ``repeats`` rollouts.
        noise: standard error of the true values' means, averaged over the cases.
    """

    learned: Float[np.ndarray, "K"]
    true: Float[np.ndarray, "K"]
    noise: float

    @property
    def bias(self) -> float:
        """Mean of learned minus true."""
        return float((self.learned - self.true).mean())

    @property
    def error(self) -> float:
        """Root mean square of learned minus true."""
        return float(np.sqrt(((self.learned - self.true) ** 2).mean()))

    @property
    def correlation(self) -> float:
        """Pearson's; NaN where either side does not vary."""
        if self.learned.std() == 0 or self.true.std() == 0:
            return float("nan")
        return float(np.corrcoef(self.learned, self.true)[0, 1])


@dataclasses.dataclass(frozen=True)
class Audit:
    """What an audit found.

    Attributes:
        value: V(s) against the return from s.
        counterfactual: V(s with only h_i := 0) against the return from the world in which i is dead.
        credit: V(s) - V(s with only h_i := 0) against the difference of the two returns: what agent i's
            life is worth.
        dead_share: (N + 1,) share of the visited states with k dead, k = 0..N.
        cases: how many pairs of state and live agent were compared.
        repeats: rollouts per case and side.
    """

    value: Comparison
    counterfactual: Comparison
    credit: Comparison
    dead_share: Float[np.ndarray, "M"]
    cases: int
    repeats: int


def audit(
    actor: Actor,
    critic: Critic,
    settings: Settings,
    *,
    worlds: int = 32,
    moments: int = 5,
    repeats: int = 8,
    seed: int = 500,
) -> Audit:
    """Compare a learned critic's counterfactuals with true ones.

    Args:
        actor: the policy, exploring as in training: its values are what the critic has learned.
        critic: of the joint state.
        settings: of the run; ``gamma`` discounts, ``weights`` price.
        worlds: episodes that states are taken from.
        moments: states per episode, evenly spread over the horizon.
        repeats: rollouts per case, each with its own random numbers.
        seed: of the episodes and of all random numbers.
    """
    torch.manual_seed(seed)
    chance = np.random.default_rng(seed)
    env = make(settings.task, worlds, seed, weights=settings.weights)
    rows, dead_share = _visit(env, actor, moments)
    n = env.num_agents
    alive = env.get_field("health", rows) > 0
    case, victim = np.nonzero(alive)
    forks = rows[case]
    for agent in range(n):
        chosen = victim == agent
        forks[chosen] = env.fork(forks[chosen], {agent: 0.0})

    value, without = _learned(env, critic, rows)
    base, base_noise = _true(actor, settings, rows, repeats, chance)
    fork, fork_noise = _true(actor, settings, forks, repeats, chance)
    return Audit(
        value=Comparison(value, base, base_noise),
        counterfactual=Comparison(without[case, victim], fork, fork_noise),
        credit=Comparison(
            value[case] - without[case, victim], base[case] - fork, float(np.hypot(base_noise, fork_noise))
        ),
        dead_share=dead_share,
        cases=len(case),
        repeats=repeats,
    )


def draw(found: Audit, path: Path, *, title: str) -> None:
    """Write a calibration plot: what the critic says against what is true, on the line where it is right."""
    panels = (
        ("value of the state", found.value),
        ("value had agent i died", found.counterfactual),
        ("worth of agent i's life", found.credit),
    )
    figure = Figure(figsize=(12, 4.9), layout="constrained")
    figure.suptitle(title, x=0.01, ha="left")
    for axes, (name, one) in zip(figure.subplots(1, 3), panels, strict=True):
        ends = [min(one.true.min(), one.learned.min()), max(one.true.max(), one.learned.max())]
        axes.plot(ends, ends, color="0.6", linewidth=1)
        axes.scatter(one.true, one.learned, s=9, alpha=0.5, linewidths=0, color="#2563a8")
        axes.set_title(f"{name}\nbias {one.bias:+.2f}, correlation {one.correlation:.2f}", fontsize=10)
        axes.set_xlabel("true: mean return of forked worlds")
        axes.set_box_aspect(1)
        axes.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("learned: what the critic says")
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=120, format="png", metadata={"Software": "hipg-bench"})


def load(path: Path) -> tuple[Actor, Critic, Settings]:
    """Read the networks of a training run.

    Args:
        path: the run's folder, or a ``learner.safetensors`` that came out of one.

    Raises:
        HipgError: there are no networks, they cannot be read, or the critic does not see the joint state.
    """
    source = path / "checkpoint.pt" if path.is_dir() else path
    if not source.is_file():
        raise HipgError(f"{source} is not there: an audit needs the critic of a MAPPO run")
    tensors, text = _checkpoint(source) if source.suffix == ".pt" else _networks(source)
    try:
        settings = parse(Settings, json.loads(text), str(source))
        spec = task_spec(settings.task)
        if ":" in settings.algorithm:  # finding it would run code that a file names
            raise HipgError(f"{path}: networks of own credit rules are not audited ({settings.algorithm})")
        actor, critic = networks(settings, definition_of(spec).layout, clips=spec.clip_actions)
        if type(critic) is not StateCritic:
            raise HipgError(
                f"{path}: an audit needs a critic of the joint state (algorithm {settings.algorithm})"
            )
        actor.load_state_dict(tensors["actor"])
        critic.load_state_dict(tensors["critic"])
    except (json.JSONDecodeError, KeyError, RuntimeError) as error:
        raise HipgError(f"{source} does not hold the networks of a MAPPO run: {error}") from error
    return actor, critic, settings


def _checkpoint(path: Path) -> tuple[dict[str, dict[str, Tensor]], str]:
    """State dictionaries and settings of a run of one's own."""
    content = checkpoint.load(path)
    return {part: content[part] for part in ("actor", "critic") if part in content}, content["settings"]


def _networks(path: Path) -> tuple[dict[str, dict[str, Tensor]], str]:
    """The same of `Trainer.save_networks`; nothing in the file is run."""
    try:
        with safetensors.safe_open(path, framework="pt") as file:
            text = (file.metadata() or {}).get("settings", "")
            found = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118  not a dict
    except (safetensors.SafetensorError, OSError) as error:
        raise HipgError(f"{path} cannot be read: {error}") from error
    return {
        part: {name[len(part) + 1 :]: one for name, one in found.items() if name.startswith(f"{part}.")}
        for part in ("actor", "critic")
    }, text


def redraw_thresholds(
    env: BatchEnv, rows: Float[np.ndarray, "X R"], chance: np.random.Generator
) -> Float[np.ndarray, "X R"]:
    """Return the rows with other hazard thresholds, drawn given that nobody who lives has died so far.

    Thresholds are exponential: what is left of one, given that the hazard so far killed nobody, is
    exponential again.
    """
    hazard = env.get_field("cumulative_hazard", rows)
    return env.set_field(rows, "hazard_threshold", hazard + chance.exponential(size=hazard.shape))


@torch.no_grad()
def _visit(
    env: BatchEnv, actor: Actor, moments: int
) -> tuple[Float[np.ndarray, "K R"], Float[np.ndarray, "M"]]:
    """Rows of states on the policy's way, and how many agents were dead in all states it saw."""
    horizon = env.spec.horizon
    taken = {round((k + 0.5) * horizon / moments) for k in range(moments)}
    step, rows = env.reset(), list[np.ndarray]()
    dead = np.zeros(env.num_agents + 1)
    for t in range(horizon):
        if t in taken:
            rows.append(env.rows)
        dead += np.bincount((~step.info["alive"]).sum(axis=1), minlength=len(dead))
        step = env.step(actor(torch.from_numpy(step.observation)).sample().numpy())
    return np.concatenate(rows), dead / dead.sum()


@torch.no_grad()
def _learned(
    env: BatchEnv, critic: Critic, rows: Float[np.ndarray, "K R"]
) -> tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K N"]]:
    """V(s), and V(s with only h_i := 0) for every agent i."""
    layout = env.layout
    values: list[np.ndarray] = []
    for some in np.split(rows, len(rows) // env.num_envs):
        info = env.load_rows(np.arange(env.num_envs), some).info
        state = torch.from_numpy(info["state"])
        copies = with_each_dead(state, layout.health_columns, layout.dead_value)
        asked = torch.cat([state[:, None], copies], dim=1)
        elapsed = torch.from_numpy(info["elapsed"] / env.spec.horizon).float()
        values.append(critic(asked, elapsed[:, None].expand(asked.shape[:2])).numpy())
    value = np.concatenate(values)
    return value[:, 0], value[:, 1:]


@torch.no_grad()
def _true(
    actor: Actor,
    settings: Settings,
    rows: Float[np.ndarray, "K R"],
    repeats: int,
    chance: np.random.Generator,
) -> tuple[Float[np.ndarray, "K"], float]:
    """Mean discounted return from every row over ``repeats`` rollouts, and its mean standard error."""
    copies = np.repeat(rows, repeats, axis=0)
    returns = np.concatenate([
        _returns(actor, settings, some, chance)
        for some in np.array_split(copies, math.ceil(len(copies) / _MOST_WORLDS))
    ]).reshape(len(rows), repeats)  # fmt: skip
    return returns.mean(axis=1), float((returns.std(axis=1, ddof=1) / math.sqrt(repeats)).mean())


def _returns(
    actor: Actor, settings: Settings, rows: Float[np.ndarray, "X R"], chance: np.random.Generator
) -> Float[np.ndarray, "X"]:
    """Discounted return from every row to the end of its episode, with fresh random numbers."""
    horizon = task_spec(settings.task).horizon
    if settings.bootstrap_truncation and settings.gamma < 1:
        horizon += math.ceil(math.log(_NEGLIGIBLE) / math.log(max(settings.gamma, 1e-9)))
    env = make(settings.task, len(rows), weights=settings.weights, horizon=horizon)
    rows = redraw_thresholds(env, rows, chance)
    step = env.load_rows(np.arange(len(rows)), rows)
    total, discount, running = np.zeros(len(rows)), 1.0, np.ones(len(rows), bool)
    for _ in range(horizon):
        step = env.step(actor(torch.from_numpy(step.observation)).sample().numpy())
        total += np.where(running, discount * step.reward, 0.0)
        running &= ~(step.terminated | step.truncated)
        discount *= settings.gamma
        if discount < _NEGLIGIBLE or not running.any():
            break
    return total
