"""Settings of training runs, and their recommended values."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import pydantic

from hipg_bench.errors import ResumeError, SpecError, hint
from hipg_bench.registry import task_spec
from hipg_bench.spec import Params, parse

Widths = Annotated[
    tuple[Annotated[int, pydantic.Field(ge=1, le=8192)], ...], pydantic.Field(min_length=1, max_length=32)
]
"""Of hidden layers."""


class RunSettings(Params):
    """Settings of every learner. The same settings give the same result on one machine.

    Attributes:
        task: task name.
        seed: fixes initial weights, worlds, exploration and samples; evaluation has seeds from 1000 on,
            so that nobody is scored on worlds they were trained in.
        steps: environment steps in all (each moves N agents).
        num_envs: B worlds side by side.
        rollout: T control steps of each in an iteration.
        gamma: discount.
        weights: reward weights that differ from the task's, in training only; logged returns have them.
        eval_every: environment steps between two periodic evaluations of the policy, which do not change
            the run; 0 evaluates it at the end only.
    """

    task: str
    seed: int = pydantic.Field(default=0, ge=0, le=999)
    steps: int = pydantic.Field(default=2_000_000, ge=1)
    num_envs: int = pydantic.Field(default=256, ge=1, le=65536)
    rollout: int = pydantic.Field(default=50, ge=1, le=10_000)
    gamma: float = pydantic.Field(default=0.98, ge=0, le=1)
    weights: dict[str, float] = pydantic.Field(default_factory=dict[str, float])
    eval_every: int = pydantic.Field(default=50_000, ge=0)

    @property
    def iterations(self) -> int:
        """Rollouts in all, the last one whole."""
        return -(-self.steps // (self.num_envs * self.rollout))

    def evaluates_after(self, iteration: int) -> bool:
        """Whether the policy is evaluated after an iteration, counted from 1."""
        each = self.num_envs * self.rollout
        held, before = ((k * each) // max(self.eval_every, 1) for k in (iteration, iteration - 1))
        return iteration == self.iterations or (self.eval_every > 0 and held > before)

    def check_resumes(self, saved: str, path: Path) -> None:
        """Refuse to go on from the checkpoint of another run.

        Args:
            saved: the checkpoint's settings as JSON; a run of an older version has today's defaults in
                what that version did not know.
            path: of the checkpoint, for the message.

        Raises:
            ResumeError: something other than ``steps`` and ``eval_every`` differs.
        """
        theirs, own = json.loads(saved), self.model_dump()
        if theirs["algorithm"] == own["algorithm"]:
            theirs = type(self)(**theirs).model_dump()
        changed = {name for name in own if own[name] != theirs.get(name)} - {"steps", "eval_every"}
        if changed:
            name = "algorithm" if "algorithm" in changed else min(changed)
            was = theirs.get(name)
            raise ResumeError(
                f"{path} was trained with {name} = {was!r}, not {own[name]!r}: choose another --out"
            )


class Settings(RunSettings):
    """Everything that defines a MAPPO run.

    Attributes:
        algorithm: how credit is assigned, a function of `hipg_bench.learning.credit`.
        epochs, minibatches: passes over a rollout, and parts each is cut into.
        gae_lambda: GAE's lambda.
        clip: PPO's epsilon.
        entropy_coef: weight of the entropy bonus; its first value where ``target_entropy`` is given.
        target_entropy: entropy of an action coordinate, nats, that the weight is moved towards after every
            rollout, so that runs of different credit rules explore alike; None leaves the weight alone. A
            normal distribution of standard deviation s has 1.42 + log(s).
        initial_policy: policy file whose weights the actor begins with, of any task with the same
            observations and actions; the critic is new. So larger teams go on from what smaller ones
            learned.
        actor_rate: the actor's first learning rate; it then follows ``target_kl``.
        critic_rate: the critic's learning rate.
        target_kl: the actor's rate is halved above twice this divergence per epoch, raised below half;
            None leaves the rate alone.
        max_grad_norm: gradients are cut to this norm.
        initial_std: exploration's first standard deviation, in units of full action.
        actor_hidden, critic_hidden: widths of the hidden layers.
        attention_groups: groups of observation blocks, by what their names begin with, that the actor looks
            at slot by slot (`hipg_bench.policies.attention`; ``actor_hidden`` begins with the embeddings'
            width); none: it is an MLP of the whole observation.
        mask_dead: dead agents' samples take no part in the actor's update; else only the algorithm
            ``min_health`` leaves them without weight, as in the authors' code.
        zero_dead_actions: a dead agent's action is stored as zeros beside the log-probability of what
            it had drawn, a quirk of the authors' code; matters only where the dead are not masked.
        dead_observation: what a dead agent's row of the observation holds in training: ``blank``, its health
            and zeros; or ``live``, what a living agent would observe there, as in the authors' code. Matters
            only where the dead are not masked.
        advantage_norm: Psi is normalised over the rollout's live samples, over the whole ``batch``, zeros of
            the dead included, or again over every ``minibatch``.
        value_clip: how far a value may move in an update before its gradient is cut, in units of
            reward, as in the authors' code; None does not clip.
        normalize_inputs, normalize_returns: running normalisation of what networks see, of value targets.
        bootstrap_truncation: an episode cut by the horizon goes on in its value target; else the
            horizon counts as an end, as in the authors' code.
        spontaneous_deaths: agents per episode, in the mean, that die without a cause, in training only,
            so that the critic meets the states its counterfactual is about.
        forks: worlds beside the rollout's in which an agent was killed, as a share of ``num_envs``; only
            the critic learns from them (`hipg_bench.learning.forks`).
    """

    algorithm: Literal["min_health", "central", "local"] = "min_health"
    epochs: int = pydantic.Field(default=5, ge=1, le=100)
    minibatches: int = pydantic.Field(default=4, ge=1, le=1000)
    gae_lambda: float = pydantic.Field(default=0.95, ge=0, le=1)
    clip: float = pydantic.Field(default=0.2, gt=0, lt=1)
    entropy_coef: float = pydantic.Field(default=0.002, ge=0, le=1)
    target_entropy: float | None = pydantic.Field(default=None, ge=-10, le=10)
    initial_policy: str | None = None
    actor_rate: float = pydantic.Field(default=1e-3, gt=0, le=1)
    critic_rate: float = pydantic.Field(default=1e-3, gt=0, le=1)
    target_kl: float | None = pydantic.Field(default=0.015, gt=0, le=1)
    max_grad_norm: float = pydantic.Field(default=1.0, gt=0)
    initial_std: float = pydantic.Field(default=0.6, gt=0, le=5)
    actor_hidden: Widths = (128, 128)
    critic_hidden: Widths = (256, 256)
    attention_groups: tuple[str, ...] = ()
    mask_dead: bool = True
    zero_dead_actions: bool = False
    dead_observation: Literal["blank", "live"] = "blank"
    advantage_norm: Literal["live", "batch", "minibatch"] = "live"
    value_clip: float | None = pydantic.Field(default=None, gt=0)
    normalize_inputs: bool = True
    normalize_returns: bool = True
    bootstrap_truncation: bool = True
    spontaneous_deaths: float = pydantic.Field(default=0.0, ge=0, le=10)
    forks: float = pydantic.Field(default=0.0, ge=0, le=1)


class ReplaySettings(RunSettings):
    """What MADDPG and QMIX share: they learn from replayed steps.

    Attributes:
        batch: steps in a sample.
        buffer: steps that are remembered, the latest.
        learning_starts: steps before the first update.
        update_every: environment steps per update.
        rate: the optimiser's learning rate.
        max_grad_norm: gradients are cut to this norm.
        tau: how far the target networks move towards the trained ones in every update.
        hidden: widths of the hidden layers of what acts.
        mask_dead: what a dead agent is told counts for nothing; else networks go on guessing for it.
        normalize_inputs: running normalisation of what networks see.
    """

    steps: int = pydantic.Field(default=1_000_000, ge=1)
    num_envs: int = pydantic.Field(default=100, ge=1, le=65536)
    gamma: float = pydantic.Field(default=0.95, ge=0, le=1)
    batch: int = pydantic.Field(default=256, ge=1, le=1_000_000)
    buffer: int = pydantic.Field(default=1_000_000, ge=1, le=100_000_000)
    learning_starts: int = pydantic.Field(default=5000, ge=1)
    update_every: float = pydantic.Field(default=12.0, gt=0)
    rate: float = pydantic.Field(default=1e-3, gt=0, le=1)
    max_grad_norm: float = pydantic.Field(default=5.0, gt=0)
    tau: float = pydantic.Field(default=0.02, gt=0, le=1)
    hidden: Widths = (128, 128)
    mask_dead: bool = True
    normalize_inputs: bool = True


class MaddpgSettings(ReplaySettings):
    """Everything that defines a MADDPG run (Lowe et al. 2017).

    Attributes:
        mask_dead: a dead agent's action is zero for every critic and its actor has no gradient; else only
            stored actions are zero, as in the authors' code, and policies are still asked.
        critic_hidden: widths of the critics' hidden layers.
        critic_sees: beside all actions, the joint ``state`` or, as in the authors' code, all agents'
            ``observations``.
        noise: exploration's first standard deviation, in units of ``action_scale``.
        final_noise: share of it that is left in the end.
        noise_steps: environment steps until then.
        pretanh_l2: weight of the mean square of the actor's outputs before they are squashed.
        action_scale: full action. The authors' MADDPG pushes five times as hard as their PPO on tasks that do
            not clip actions.
    """

    algorithm: Literal["maddpg"] = "maddpg"
    critic_hidden: Widths = (256, 256)
    critic_sees: Literal["state", "observations"] = "state"
    noise: float = pydantic.Field(default=0.3, ge=0, le=2)
    final_noise: float = pydantic.Field(default=0.3, ge=0, le=1)
    noise_steps: int = pydantic.Field(default=150_000, ge=1)
    pretanh_l2: float = pydantic.Field(default=1e-3, ge=0)
    action_scale: float = pydantic.Field(default=1.0, gt=0, le=10)


class QmixSettings(ReplaySettings):
    """Everything that defines a QMIX run (Rashid et al. 2018).

    Attributes:
        mask_dead: a dead agent's values are zero, whatever it is told.
        bins: values an action coordinate may take, evenly spaced from -1 to 1.
        mixer_width: of the mixing network.
        epsilon: share of random choices in the end; all are at first.
        epsilon_steps: environment steps until then.
    """

    algorithm: Literal["qmix"] = "qmix"
    gamma: float = pydantic.Field(default=0.9, ge=0, le=1)
    learning_starts: int = pydantic.Field(default=2000, ge=1)
    max_grad_norm: float = pydantic.Field(default=10.0, gt=0)
    tau: float = pydantic.Field(default=0.01, gt=0, le=1)
    hidden: Widths = (64, 64)
    bins: int = pydantic.Field(default=8, ge=2, le=256)
    mixer_width: int = pydantic.Field(default=32, ge=1, le=4096)
    epsilon: float = pydantic.Field(default=0.05, ge=0, le=1)
    epsilon_steps: int = pydantic.Field(default=20_000, ge=1)


AnySettings = Settings | MaddpgSettings | QmixSettings

ALGORITHMS: Mapping[str, type[Settings] | type[MaddpgSettings] | type[QmixSettings]] = {
    "min_health": Settings,
    "central": Settings,
    "local": Settings,
    "maddpg": MaddpgSettings,
    "qmix": QmixSettings,
}
"""Settings of each algorithm."""
SYNONYMS: Mapping[str, str] = {"mappo": "central", "ippo": "local"}
"""Other names that the field uses."""


_EPISODES_PER_EVALUATION = 1000
"""Training episodes between two periodic evaluations, which take 3 % of the time or less."""
_BY_FAMILY: Mapping[str, dict[str, Any]] = {
    # what a drone does shows in the team's distances at once: a short trace has less of the other agents'
    # randomness
    "hazard_nav": {
        "steps": 3_000_000, "minibatches": 8, "gamma": 0.9, "gae_lambda": 0.9, "entropy_coef": 0.008,
        # one way of looking at every point: what an MLP has to learn for each of them separately
        "attention_groups": ("point", "neighbor"), "actor_hidden": (32, 128),
    },
    # reward is so rare at first that noise would collapse exploration without a strong bonus
    "hazard_comm": {
        "epochs": 4, "minibatches": 8, "entropy_coef": 0.01,
        "attention_groups": ("neighbor", "wreck"), "actor_hidden": (32, 128),
    },
    "multiwalker": {
        "steps": 12_000_000, "num_envs": 512, "rollout": 32, "minibatches": 6, "gamma": 0.99,
        "entropy_coef": 0.001, 
        "initial_std": 0.3,  # teams that fall less often learn to stand in a fifth of the steps
        "weights": {"alive": 0.1},  # without it teams learn to dive before they learn to stand
    },
}  # fmt: skip
"""Where a family does better with other values than the defaults."""
_WALKERS_REPLAYED: dict[str, Any] = {
    "steps": 3_000_000, "update_every": 25, "weights": {"alive": 0.1}, "eval_every": 200_000,
}  # fmt: skip
_MADDPG_BY_FAMILY: Mapping[str, dict[str, Any]] = {
    "multiwalker": {**_WALKERS_REPLAYED, "gamma": 0.99, "noise_steps": 1_000_000},
}
_QMIX_BY_FAMILY: Mapping[str, dict[str, Any]] = {
    # a longer view, faster targets or slower exploration, and the best of 12 choices at once is so
    # overestimated that values grow without bound
    "multiwalker": {**_WALKERS_REPLAYED, "gamma": 0.95, "tau": 0.005},
}


def recommended(task: str, **changes: Any) -> AnySettings:
    """The recommended settings for a task, with some changed; ``algorithm`` says for which learner.

    Raises:
        UnknownNameError: no such task.
        SpecError: no such algorithm, or a setting that is not allowed.
    """
    family, algorithm = task_spec(task).family, _algorithm(changes)
    by_family = {"maddpg": _MADDPG_BY_FAMILY, "qmix": _QMIX_BY_FAMILY}.get(algorithm, _BY_FAMILY)
    return _parsed(task, algorithm, {**by_family.get(family, {}), **changes})


def _algorithm(changes: Mapping[str, Any]) -> str:
    """The algorithm's own name, where one of its synonyms may have been given."""
    name = str(changes.get("algorithm", "min_health"))
    return SYNONYMS.get(name, name)


def _parsed(task: str, algorithm: str, values: dict[str, Any]) -> AnySettings:
    if algorithm not in ALGORITHMS:
        near = hint(algorithm, [*ALGORITHMS, *SYNONYMS])
        raise SpecError(f"training {task}: no algorithm {algorithm!r}{near}")
    every = _EPISODES_PER_EVALUATION * task_spec(task).horizon
    return parse(
        ALGORITHMS[algorithm],
        {"task": task, "eval_every": every, **values, "algorithm": algorithm},
        f"training {task}",
    )


_PAPER: dict[str, Any] = {
    "steps": 2_500_000, "epochs": 8, "minibatches": 8, "gamma": 0.95, "gae_lambda": 1.0, "entropy_coef": 0.01,
    "critic_rate": 5e-3, "target_kl": None, "max_grad_norm": 0.5, "initial_std": 1.0,
    "actor_hidden": (64, 64), "critic_hidden": (64,) * 8,
    "mask_dead": False, "zero_dead_actions": True, "advantage_norm": "minibatch", "value_clip": 0.2,
    "normalize_inputs": False, "normalize_returns": False, "bootstrap_truncation": False,
}  # fmt: skip
_PAPER_ALGORITHMS: Mapping[str, dict[str, Any]] = {
    "local": {"critic_hidden": (64, 64), "critic_rate": 1e-3},
    "central": {},
    "min_health": {"advantage_norm": "batch"},
}
_PAPER_WALKERS: dict[str, Any] = {
    "steps": 5_000_000, "num_envs": 128, "rollout": 128, "epochs": 32, "minibatches": 4, "gamma": 0.99,
    "entropy_coef": 0.0, "clip": 0.3, "actor_rate": 3e-4, "critic_rate": 3e-4, "value_clip": 10.0,
    "max_grad_norm": 1e6,
}  # fmt: skip


_PAPER_MADDPG: dict[str, Any] = {
    "steps": 2_500_000, "gamma": 0.95, "batch": 1024, "buffer": 1_000_000, "learning_starts": 51_200,
    "update_every": 100, "rate": 1e-2, "max_grad_norm": 0.5, "tau": 0.01, "hidden": (64, 64),
    "critic_hidden": (64, 64), "critic_sees": "observations", "pretanh_l2": 1e-3,
    "mask_dead": False, "normalize_inputs": False,
}  # fmt: skip
_PAPER_QMIX: dict[str, Any] = {
    "steps": 5_000_000, "gamma": 0.99, "batch": 100, "buffer": 100_000, "learning_starts": 1000,
    "update_every": 100, "rate": 5e-4, "max_grad_norm": 10.0, "tau": 0.2, "hidden": (64, 64),
    "bins": 8, "mixer_width": 32, "epsilon": 0.02, "epsilon_steps": 10_000,
    "mask_dead": False, "normalize_inputs": False,
}  # fmt: skip


def paper(task: str, **changes: Any) -> AnySettings:
    """The paper's settings, with the quirks of the authors' code, with some changed.

    Source: facts sheet, section 5 (particles) and section 6c (walkers, where gamma, lambda, clip and
    value clip are not stated and RLlib's defaults of the time are taken). The critic is told the share
    of the horizon that has passed where the authors feed the number of steps left.

    Of MADDPG the sheet gives everything but the learning rate, which is the default of the authors' code;
    its soft choice among five directions is a continuous push here, with Gaussian noise. Of QMIX the
    paper states the number of bins alone; the rest are RLlib's defaults of the time, where an update is of
    one whole episode (about 100 steps here) and follows each episode, but without recurrence, and with
    targets that follow smoothly where RLlib copies them every 500 steps.

    Raises:
        UnknownNameError: no such task.
        SpecError: no such algorithm, or a setting that is not allowed.
    """
    spec, algorithm = task_spec(task), _algorithm(changes)
    if algorithm == "maddpg":
        action_scale = 1.0 if spec.clip_actions else 5.0
        return _parsed(task, algorithm, {**_PAPER_MADDPG, "action_scale": action_scale, **changes})
    if algorithm == "qmix":
        return _parsed(task, algorithm, {**_PAPER_QMIX, **changes})
    walkers = _PAPER_WALKERS if spec.family == "multiwalker" else {}
    return _parsed(task, algorithm, {**_PAPER, **walkers, **_PAPER_ALGORITHMS.get(algorithm, {}), **changes})


PRESETS: Mapping[str, Callable[..., AnySettings]] = {"recommended": recommended, "paper": paper}
"""Ready-made settings by name."""
