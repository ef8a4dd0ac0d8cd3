"""Settings of training runs, and their recommended values."""

from __future__ import annotations

import json
import pkgutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, cast

import pydantic

from hipg_bench.documents import read_toml
from hipg_bench.errors import ResumeError, SpecError, hint
from hipg_bench.families.known import declared, lineage
from hipg_bench.registry import task_spec
from hipg_bench.spec import Params, parse

Widths = Annotated[
    tuple[Annotated[int, pydantic.Field(ge=1, le=8192)], ...], pydantic.Field(min_length=1, max_length=32)
]
"""Of hidden layers."""


CREDIT_RULES = tuple(
    sorted(module.name for module in pkgutil.iter_modules([str(Path(__file__).parent / "credit")]))
)
"""MAPPO's credit rules: the files of `hipg_bench.learning.credit`."""
_RULE = rf"^({'|'.join(CREDIT_RULES)}|[A-Za-z_][\w.]*:[A-Za-z_]\w*)$"


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

    learner: ClassVar[str]
    """Module of `hipg_bench.learning` whose ``Trainer`` these are for, and table of the presets."""

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
        algorithm: how credit is assigned: a rule of `hipg_bench.learning.credit`, or ``module:function``.
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
        mask_dead_values: values of dead agents are not trained, where a critic has one for each agent
            (``local``, ``difference_rewards``); else they are.
        credit_samples: actions that ``coma`` draws for each expectation.
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
    """

    learner: ClassVar[str] = "mappo"

    algorithm: str = pydantic.Field(default="min_health", pattern=_RULE)
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
    mask_dead_values: bool = False
    credit_samples: int = pydantic.Field(default=8, ge=1, le=256)
    zero_dead_actions: bool = False
    dead_observation: Literal["blank", "live"] = "blank"
    advantage_norm: Literal["live", "batch", "minibatch"] = "live"
    value_clip: float | None = pydantic.Field(default=None, gt=0)
    normalize_inputs: bool = True
    normalize_returns: bool = True
    bootstrap_truncation: bool = True


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

    learner: ClassVar[str] = "maddpg"

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

    learner: ClassVar[str] = "qmix"

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
    **dict.fromkeys(CREDIT_RULES, Settings), "maddpg": MaddpgSettings, "qmix": QmixSettings,
}  # fmt: skip
"""Settings of each algorithm: MAPPO's, by its credit rule, or another learner's."""
SYNONYMS: Mapping[str, str] = {"mappo": "central", "ippo": "local"}
"""Other names that the field uses."""

_EPISODES_PER_EVALUATION = 1000
"""Training episodes between two periodic evaluations, which take 3 % of the time or less."""


def settings_type(algorithm: str) -> type[Settings] | type[MaddpgSettings] | type[QmixSettings]:
    """What defines a run of an algorithm; ``module:function`` is a credit rule from outside.

    Raises:
        SpecError: no such algorithm.
    """
    algorithm = SYNONYMS.get(algorithm, algorithm)
    if ":" in algorithm:
        return Settings
    if algorithm not in ALGORITHMS:
        raise SpecError(f"no algorithm {algorithm!r}{hint(algorithm, [*ALGORITHMS, *SYNONYMS])}")
    return ALGORITHMS[algorithm]


def recommended(task: str, **changes: Any) -> AnySettings:
    """The recommended settings for a task, with some changed; ``algorithm`` says for which learner.

    Raises:
        UnknownNameError: no such task.
        SpecError: no such algorithm, or a setting that is not allowed.
    """
    return _preset("recommended", task, changes)


def paper(task: str, **changes: Any) -> AnySettings:
    """The paper's settings, with the quirks of the authors' code, with some changed.

    Their sources are in ``presets/paper.toml``.

    Raises:
        UnknownNameError: no such task.
        SpecError: no such algorithm, or a setting that is not allowed.
    """
    return _preset("paper", task, changes)


PRESETS: Mapping[str, Callable[..., AnySettings]] = {"recommended": recommended, "paper": paper}
"""Ready-made settings by name."""


def read_settings(path: Path) -> dict[str, Any]:
    """Some settings from a TOML file, such as `to_toml` writes; ``"none"`` is no value.

    Raises:
        SpecError: it cannot be read.
    """
    return {name: None if value == _NONE else value for name, value in read_toml(path).items()}


def to_toml(settings: AnySettings) -> str:
    """All settings of a run but its task and seed, as a TOML file that `read_settings` takes."""
    lines: list[str] = []
    for name, value in settings.model_dump(mode="json").items():
        if isinstance(value, dict):
            pairs = cast(dict[str, Any], value).items()
            text = "{" + ", ".join(f" {key} = {json.dumps(one)}" for key, one in pairs) + " }"
        else:
            text = json.dumps(_NONE if value is None else value)
        if name not in ("task", "seed"):
            lines.append(f"{name} = {text}")
    return "\n".join(lines) + "\n"


_NONE = "none"


def _preset(name: str, task: str, changes: Mapping[str, Any]) -> AnySettings:
    """A preset's tables for a task and algorithm, one over the other, under what is changed."""
    spec = task_spec(task)
    algorithm = str(changes.get("algorithm", "min_health"))
    algorithm = SYNONYMS.get(algorithm, algorithm)
    kind = settings_type(algorithm)
    tables = read_settings(Path(__file__).parent / "presets" / f"{name}.toml").get(kind.learner, {})
    values: dict[str, Any] = {"task": task, "eval_every": _EPISODES_PER_EVALUATION * spec.horizon}
    by_family = tables.get("family", {})
    shared = next((by_family[each] for each in lineage(spec.family) if each in by_family), {})
    own = (declared(spec.family, "SETTINGS") or {}) if name == "recommended" else {}
    for table in (
        tables.get("all", {}),
        shared,
        own.get(algorithm, {}),
        tables.get("algorithm", {}).get(algorithm, {}),
        tables.get("task", {}).get(task, {}),
    ):
        values |= {key: None if value == _NONE else value for key, value in table.items()}
    return parse(kind, {**values, **changes, "algorithm": algorithm}, f"training {task}")
