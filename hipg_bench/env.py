"""B worlds of one task, stepped together. `BatchEnv.step` is the architecture in one function."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int

from hipg_bench import episode
from hipg_bench.arguments import MOST_EPISODE, MOST_SEED, numbers, whole
from hipg_bench.episode import NEVER, memory_fields
from hipg_bench.errors import ActionError, HipgError, SpecError
from hipg_bench.families.family import Family, Harm
from hipg_bench.families.scene import without_visuals
from hipg_bench.layout import TaskLayout
from hipg_bench.mechanics import health as health_law
from hipg_bench.sim import Sim
from hipg_bench.spec import TaskSpec


def world_model(spec: TaskSpec, family: Family, *, visual: bool = False) -> mujoco.MjModel:
    """Compile a task's world; the state rows are the same with and without what only a camera sees."""
    scene = family.scene() if visual else without_visuals(family.scene())
    scene.nuserdata = sum(memory_fields(spec, family).values())
    try:
        return scene.compile()
    except ValueError as error:
        said = " ".join(str(error).split())
        raise SpecError(f"{spec.task}: MuJoCo refuses a world with these numbers: {said}") from error


@dataclasses.dataclass(frozen=True)
class Step:
    """What one control step returns. Arrays are the caller's to keep.

    Attributes:
        observation: (B, N, O) float32, of the new episode where one just ended. A dead agent's row
            holds its own health 0 and zeros.
        reward: (B,) team reward of the step.
        terminated: (B,) the rules ended the episode.
        truncated: (B,) the horizon ended it.
        info: ``state`` (B, S) float32; ``health`` (B, N); ``alive`` (B, N) bool; ``terms`` name to (B,),
            weighted, their sum is the reward; ``final_alive`` (B, N) who outlived the step, whether or not
            an episode ended; ``metrics`` name to (B,), NaN but where one did; ``end_reason`` (B,) str, empty
            but there; ``final_observation`` (n, N, O), ``final_state`` (n, S) and ``final_rows`` (n, R), the
            last of the n worlds whose episode ended, in their order; ``episode_id`` (B,) and ``elapsed``
            (B,) control steps of the episode that the observation is of.
    """

    observation: Float[np.ndarray, "B N O"]
    reward: Float[np.ndarray, "B"]
    terminated: Bool[np.ndarray, "B"]
    truncated: Bool[np.ndarray, "B"]
    info: dict[str, Any]


class BatchEnv:
    """B worlds of one task.

    What happens in an episode depends on (seed, episode id) and the actions, never on B, on the
    thread count or on which world runs it. World b starts with episode b; a world that ends goes on
    with the next id not yet used, in the same step, or waits for `reset` where ``autoreset`` is off.

    Attributes:
        spec: the task's numbers.
        layout: what each number of an observation, action and joint state is.
        model: the compiled MjModel.
        decimation: physics steps per control step.
        metrics: names in ``Step.info["metrics"]``.
        num_envs, num_agents, action_size, observation_size, state_size: B, N, A, O, S.
    """

    def __init__(
        self,
        spec: TaskSpec,
        family: Family,
        num_envs: int,
        seed: int,
        *,
        threads: int = 0,
        autoreset: bool = True,
    ) -> None:
        self.spec = spec
        self.family = family
        self.layout: TaskLayout = family.layout
        self.num_envs = num_envs
        self.num_agents = spec.num_agents
        self.action_size = family.layout.action.size
        self.observation_size = family.layout.observation.size
        self.state_size = family.layout.state.size
        self.metrics = (*episode.METRICS, *family.metrics)
        self.decimation = family.physics_steps
        self.model = world_model(spec, family)
        self._threads = threads
        self._sim = self._new_sim()
        self._seed = seed
        self._autoreset = autoreset
        self._next_episode = 0
        self._now: Any = None
        self._waiting = np.ones(num_envs, bool)
        self._closed = False

    def __getstate__(self) -> dict[str, Any]:
        """What pickle and deepcopy keep: how it was built, and the worlds as they are."""
        return {
            "built": (self.spec, self.family, self.num_envs, self._seed),
            "options": {"threads": self._threads, "autoreset": self._autoreset},
            "rows": self.rows, "waiting": self._waiting, "next_episode": self._next_episode,
            "begun": self._now is not None, "closed": self._closed,
        }  # fmt: skip

    def __setstate__(self, kept: Mapping[str, Any]) -> None:
        """Go on where the original was."""
        self.__init__(*kept["built"], **kept["options"])
        self._next_episode, self._closed = kept["next_episode"], kept["closed"]
        if kept["begun"]:
            self._take_over(kept["rows"])
            self._waiting = np.array(kept["waiting"])

    def reset(
        self,
        episode_id: Int[np.ndarray, "n"] | None = None,
        *,
        worlds: Int[np.ndarray, "n"] | None = None,
        seed: int | None = None,
    ) -> Step:
        """Start worlds anew.

        Args:
            episode_id: (n,) the episodes to run, by default the next not yet used.
            worlds: (n,) the worlds to start, by default all of them, n = B.
            seed: a new seed, for all episodes that start from now on; it counts them from 0 again.

        Returns:
            What the agents see now, in all worlds; reward 0.

        Raises:
            HipgError: episodes outside 0..2^53 - 1, a seed outside 0..2^64 - 1, or worlds outside 0..B-1 or
                named twice.
        """
        self._check_open()
        ids = self._checked_worlds(np.arange(self.num_envs) if worlds is None else worlds)
        if seed is not None:
            seed = whole(seed, f"{self.spec.task}: seed", 0, MOST_SEED)
        first = self._next_episode if seed is None else 0
        episodes = first + np.arange(len(ids)) if episode_id is None else self._checked_episodes(episode_id)
        if episodes.shape != ids.shape:
            raise HipgError(
                f"{self.spec.task}: {len(ids)} episode ids are allowed, one for each world, "
                f"got {episodes.tolist()}"
            )
        if seed is not None:
            self._seed, self._next_episode = seed, 0
        if len(ids):
            self._begin(ids, episodes)
        return self._resume(ids)

    def step(self, action: Float[np.ndarray, "B N A"]) -> Step:
        """Advance every world by one control step; worlds whose episode ends start their next one.

        Args:
            action: (B, N, A), in [-1, 1]; what lies outside is clipped (where the spec says so), and what
                dead agents are told is ignored.

        Raises:
            ActionError: wrong shape, or a value that is not finite, naming the env and the agent.
        """
        action = self._checked(action)
        sim, family, field, was = self._sim, self.family, self._sim.field, self._now

        # the world moves; the dead exert no force
        if self.spec.graded_health:
            action = action * field["health"][:, :, None]
        family.act(sim, was, action)
        diverged = sim.advance()
        now = family.read(sim)

        # harm becomes death
        field["elapsed"] += 1
        self._wound(now, family.harm(was, now))
        now = family.remember(sim, was, now)

        # the team is paid, and told how it ended
        terms = self._weighted(family.reward(was, now))
        ruled, reason = family.terminated(now)
        terminated = ruled | diverged
        truncated = ~terminated & (field["elapsed"][:, 0] >= self.spec.horizon)
        terms = self._pay_floor(terms, diverged)
        # one after another: NumPy may pair the summands by the number of worlds, which changes last bits
        reward = sum(terms.values(), np.zeros(self.num_envs))
        field["return"][:, 0] += reward
        done = terminated | truncated
        (ended,) = done.nonzero()
        end_reason = np.full(self.num_envs, "")
        if len(ended):
            by_rule = np.where(ruled, reason, np.where(truncated, "horizon", ""))
            end_reason = np.where(diverged, "physics", by_rule)

        # what was seen, then the next episode where this one is over
        observation, state = self._perceive(now)
        info: dict[str, Any] = {
            "final_observation": observation[ended], "final_state": state[ended],
            "final_rows": sim.rows[ended], "final_alive": now.health > 0,
            "terms": terms, "end_reason": end_reason, "metrics": self._measure(now, ended),
        }  # fmt: skip
        if len(ended) and self._autoreset:
            self._begin(ended, self._next_episode + np.arange(len(ended)))
            fresh = family.read(sim, ended)
            observation[ended], state[ended] = self._perceive(fresh)
            self._now = fresh if len(ended) == self.num_envs else family.renew(sim, now, ended, fresh)
        else:
            self._now, self._waiting = now, done
        return Step(observation, reward, terminated, truncated, info | self._present(state))

    @property
    def rows(self) -> Float[np.ndarray, "B R"]:
        """A copy of all worlds: row b is everything that evolves in world b."""
        return self._sim.rows.copy()

    def load_rows(self, ids: Int[np.ndarray, "n"], rows: Float[np.ndarray, "n R"]) -> Step:
        """Put saved worlds into places ``ids``; return what agents see now, reward 0.

        Raises:
            HipgError: rows of another task, or ids outside 0..B-1 or named twice.
        """
        self._check_open()
        ids = self._checked_worlds(ids)
        expected = (len(ids), self._sim.rows.shape[1])
        if rows.shape != expected:
            raise HipgError(f"{self.spec.task}: rows of shape {expected} are allowed, got {rows.shape}")
        self._sim.reset(ids)
        self._sim.rows[ids] = rows
        self._next_episode = max(self._next_episode, int(self._sim.field["episode_id"].max()) + 1)
        return self._resume(ids)

    def fork(self, rows: Float[np.ndarray, "n R"], health: Mapping[int, float]) -> Float[np.ndarray, "n R"]:
        """Return copies of saved worlds in which some agents' health is set: the true counterfactual.

        This is the world that eqn:min_health_baseline of the paper asks about. Health only falls.

        Args:
            rows: saved worlds.
            health: agent to its new health, in [0, 1].

        Raises:
            HipgError: an agent outside 0..N-1, or a health outside [0, 1].
        """
        forked = rows.copy()
        current = self._sim.userdata_of(forked, "health")
        died_at = self._sim.userdata_of(forked, "death_time")
        elapsed = self._sim.userdata_of(forked, "elapsed")[:, 0]
        for agent, value in health.items():
            if not (0 <= agent < self.num_agents and 0 <= value <= 1):
                raise HipgError(
                    f"{self.spec.task}: agents 0..{self.num_agents - 1} and health in [0, 1] are allowed, "
                    f"got health[{agent}] = {value}"
                )
            if value == 0:
                died_at[:, agent] = np.where(current[:, agent] > 0, elapsed, died_at[:, agent])
            current[:, agent] = np.minimum(current[:, agent], value)
        return forked

    def recall(self, rows: Float[np.ndarray, "n R"], name: str) -> Float[np.ndarray, "n size"]:
        """What saved worlds remember, by name, e.g. ``death_time`` (control steps, `NEVER` while alive)."""
        return self._sim.userdata_of(rows, name)

    def close(self) -> None:
        """Refuse further use."""
        self._closed = True

    def _begin(self, ids: Int[np.ndarray, "n"], episodes: Int[np.ndarray, "n"]) -> None:
        """Start episodes in worlds ``ids``: all chance of an episode is drawn here."""
        n = self.num_agents
        chance = episode.draw(self._seed, episodes, n + self.family.chance_size)
        self._sim.reset(ids)
        field = self._sim.field
        field["health"][ids] = 1.0
        field["toughness"][ids] = -np.log1p(-chance[:, :n])
        field["death_time"][ids] = NEVER
        field["episode_id"][ids, 0] = episodes
        self._next_episode = max(self._next_episode, int(episodes.max(initial=-1)) + 1)
        self.family.reset(self._sim, ids, chance[:, n:])

    def _resume(self, ids: Int[np.ndarray, "n"]) -> Step:
        """Look at the worlds as they stand; ``ids`` are ready to go on."""
        self._waiting[ids] = False
        self._sim.disable(self._sim.field["health"] == 0)
        self._now = self.family.read(self._sim)
        observation, state = self._perceive(self._now)
        nothing = np.zeros(self.num_envs, bool)
        info: dict[str, Any] = {
            "final_observation": observation[:0].copy(), "final_state": state[:0].copy(),
            "final_rows": self._sim.rows[:0].copy(), "final_alive": self._sim.field["health"] > 0,
            "terms": {name: np.zeros(self.num_envs) for name in (*self.spec.weights, "physics")},
            "end_reason": np.full(self.num_envs, ""),
            "metrics": self._measure(self._now, np.empty(0, np.int64)),
        }  # fmt: skip
        info |= self._present(state)
        return Step(observation, np.zeros(self.num_envs), nothing, nothing.copy(), info)

    def _present(self, state: Float[np.ndarray, "B S"]) -> dict[str, Any]:
        """The part of ``info`` that belongs to the episode the observation is of."""
        field = self._sim.field
        return {
            "state": state,
            "health": field["health"].copy(),
            "alive": field["health"] > 0,
            "episode_id": field["episode_id"][:, 0].astype(np.int64),
            "elapsed": field["elapsed"][:, 0].astype(np.int64),
        }

    def _perceive(self, now: Any) -> tuple[Float[np.ndarray, "n N O"], Float[np.ndarray, "n S"]]:
        """Observations, the dead blinded (property 4 of the paper), and joint states."""
        observation, layout = self.family.observe(now), self.layout
        dead = now.health == 0
        if self.spec.dead_observation == "blank" and dead.any():
            observation[dead] = 0.0
            observation[dead, layout.observation.slices[layout.health_block]] = layout.dead_value
        return observation, self.family.state(now)

    def _measure(self, now: Any, ids: Int[np.ndarray, "n"]) -> dict[str, Float[np.ndarray, "B"]]:
        """Metrics of the episodes that end in worlds ``ids``; NaN elsewhere."""
        out = dict(zip(self.metrics, np.full((len(self.metrics), self.num_envs), np.nan), strict=True))
        if len(ids):
            told = episode.measure(self._sim.field, ids) | self.family.measure(self._sim, ids, now)
            for name, value in told.items():
                out[name][ids] = value
        return out

    def _wound(self, now: Any, harm: Harm) -> None:
        """Turn harm into death, in the snapshot too; actuators of the dead are cut."""
        sim, field, hurt = self._sim, self._sim.field, harm.cases
        if not len(hurt[0]):
            return
        had = field["health"][hurt]
        health, field["exposure"][hurt] = health_law.damage(
            had, field["exposure"][hurt], field["toughness"][hurt], harm.exposure[hurt], harm.fatal[hurt],
            graded=self.spec.graded_health,
        )  # fmt: skip
        field["health"][hurt] = now.health[hurt] = health
        died = tuple(axis[(health == 0) & (had > 0)] for axis in hurt)
        if len(died[0]):
            field["death_time"][died] = field["elapsed"][died[0], 0]
            field["death_cause"][died] = harm.cause[died]
            sim.disable(now.health == 0)

    def _weighted(self, terms: Mapping[str, Float[np.ndarray, "B"]]) -> dict[str, Float[np.ndarray, "B"]]:
        """The family's terms times the task's weights."""
        weights = self.spec.weights
        if not terms.keys() <= weights.keys():
            missing = ", ".join(sorted(terms.keys() - weights.keys()))
            raise SpecError(f"{self.spec.task}: weights need {missing}, the family's reward terms")
        return {name: weights[name] * term for name, term in terms.items()}

    def _pay_floor(
        self, terms: dict[str, Float[np.ndarray, "B"]], diverged: Bool[np.ndarray, "B"]
    ) -> dict[str, Float[np.ndarray, "B"]]:
        """Make the return of diverged episodes the task's floor, so that breaking physics never pays."""
        if not diverged.any():
            return {**terms, "physics": np.zeros(self.num_envs)}
        floor = self.spec.floor - self._sim.field["return"][:, 0]
        paid = {name: np.where(diverged, 0.0, term) for name, term in terms.items()}
        return {**paid, "physics": np.where(diverged, floor, 0.0)}

    def _checked(self, action: Float[np.ndarray, "B N A"]) -> Float[np.ndarray, "B N A"]:
        self._check_open()
        if self._now is None:
            raise HipgError(f"{self.spec.task}: step() before reset()")
        if self._waiting.any():
            raise HipgError(
                f"{self.spec.task}: env {int(self._waiting.argmax())} is waiting for reset(), "
                f"its episode is over or has not begun"
            )
        action = numbers(action, self.spec.task, whose=" as actions").astype(np.float64, copy=False)
        expected = (self.num_envs, self.num_agents, self.action_size)
        if action.shape != expected:
            raise ActionError(
                f"{self.spec.task}: actions of shape {expected} (B, N, A) are allowed, got {action.shape}"
            )
        alive = self._sim.field["health"] > 0
        # a sum is finite only if all its terms are
        with np.errstate(over="ignore", invalid="ignore"):
            finite = np.isfinite(action.sum())
        if not finite:
            self._refuse_infinite(action, alive)
        if self.spec.clip_actions:
            action = action.clip(-1.0, 1.0)
        if not alive.all():
            action = action.copy()
            action[~alive] = 0.0
        return action

    def _refuse_infinite(self, action: Float[np.ndarray, "B N A"], alive: Bool[np.ndarray, "B N"]) -> None:
        """Raise if somebody alive is told a number that is not finite."""
        bad = alive[:, :, None] & ~np.isfinite(action)
        if bad.any():
            env, agent, axis = np.argwhere(bad)[0].tolist()
            raise ActionError(
                f"{self.spec.task}: finite actions are allowed, got {action[env, agent, axis]} "
                f"for env {env}, agent {agent} ({self.layout.action.blocks[0].name}[{axis}])"
            )

    def _checked_worlds(self, worlds: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
        worlds = np.atleast_1d(self._checked_integers(worlds, "worlds"))
        inside = (worlds >= 0) & (worlds < self.num_envs)
        if not inside.all() or len(np.unique(worlds)) < len(worlds):
            raise HipgError(
                f"{self.spec.task}: distinct worlds in 0..{self.num_envs - 1} are allowed, "
                f"got {worlds.tolist()}"
            )
        return worlds

    def _checked_episodes(self, episode_id: Int[np.ndarray, "n"]) -> Int[np.ndarray, "n"]:
        episodes = np.atleast_1d(self._checked_integers(episode_id, "episode ids"))
        if (episodes < 0).any() or (episodes > MOST_EPISODE).any():
            raise HipgError(
                f"{self.spec.task}: episode ids in 0..2^53 - 1 are allowed, got {episodes.tolist()}"
            )
        return episodes

    def _checked_integers(self, values: Any, what: str) -> Int[np.ndarray, "..."]:
        array = numbers(values, self.spec.task, whose=f" as {what}")
        if array.dtype.kind not in "iu" and array.size:
            raise HipgError(f"{self.spec.task}: whole numbers are allowed as {what}, got {array.dtype}")
        if array.dtype.kind == "u" and array.size and array.max() > MOST_EPISODE:
            raise HipgError(f"{self.spec.task}: {what} up to 2^53 - 1 are allowed, got {array.tolist()}")
        return array.astype(np.int64)

    def _check_open(self) -> None:
        if self._closed:
            raise HipgError(f"{self.spec.task}: this environment is closed")
        if self._sim.lost:
            rows = self._sim.rows.copy()
            self._sim = self._new_sim()
            if self._now is not None:
                self._take_over(rows)

    def _new_sim(self) -> Sim:
        fields = memory_fields(self.spec, self.family)
        return Sim(self.model, self.num_envs, fields, decimation=self.decimation, threads=self._threads)

    def _take_over(self, rows: Float[np.ndarray, "B R"]) -> None:
        """Go on from rows that were saved a moment ago; who waits for reset goes on waiting."""
        self._sim.rows[:] = rows
        self._sim.disable(self._sim.field["health"] == 0)
        self._now = self.family.read(self._sim)
        self._perceive(self._now)


__all__ = ["NEVER", "BatchEnv", "Step", "world_model"]
