"""B worlds of one task, stepped together: what users call. What a step does is in `hipg_bench.engine`."""

from __future__ import annotations

import dataclasses
import html
import pkgutil
from collections.abc import Mapping
from typing import Any, NoReturn, TypedDict

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from hipg_bench import episode
from hipg_bench.arguments import MOST_EPISODE, MOST_SEED, numbers, whole
from hipg_bench.errors import ActionError, HipgError, RenderError, SpecError, UnknownNameError, hint
from hipg_bench.families.family import METRICS, NEVER, Definition
from hipg_bench.families.scene import without_visuals
from hipg_bench.layout import TaskLayout
from hipg_bench.records import places
from hipg_bench.stepper import Stepper


def world_model(definition: Definition, *, visual: bool = False) -> mujoco.MjModel:
    """Compile a task's world; the state rows are the same with and without what only a camera sees."""
    scene = definition.scene() if visual else without_visuals(definition.scene())
    scene.nuserdata = sum(int(np.prod(axes, dtype=int)) for axes in definition.memory.values())
    try:
        return scene.compile()
    except ValueError as error:
        said = " ".join(str(error).split())
        raise SpecError(
            f"{definition.spec.task}: MuJoCo refuses a world with these numbers: {said}"
        ) from error


_PICTURES, _PNG = "hipg_bench.rendering.live:Stills", "hipg_bench.rendering.live:png"
"""What draws worlds: named here and imported by the first picture, as rendering is built on this module."""
_PIXELS = 64, 4096
"""Smallest and largest side of a picture."""


class Info(TypedDict):
    """What a step tells beside observation and reward; see `Step`."""

    state: Float32[np.ndarray, "B S"]
    health: Float[np.ndarray, "B N"]
    alive: Bool[np.ndarray, "B N"]
    terms: dict[str, Float[np.ndarray, "B"]]
    metrics: dict[str, Float[np.ndarray, "B"]]
    end_reason: np.ndarray
    episode_id: Int[np.ndarray, "B"]
    elapsed: Int[np.ndarray, "B"]
    final_alive: Bool[np.ndarray, "B N"]
    final_observation: Float32[np.ndarray, "n N O"]
    final_state: Float32[np.ndarray, "n S"]
    final_rows: Float[np.ndarray, "n R"]


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
    info: Info


class BatchEnv:
    """B worlds of one task.

    What happens in an episode depends on (seed, episode id) and the actions, never on B, on the
    thread count or on which world runs it. World b starts with episode b; a world that ends starts
    the next id not yet used, in the same step, or waits for `reset` where ``autoreset`` is off.

    Attributes:
        spec: the task's numbers.
        definition: what the task's family says of them.
        layout: what each number of an observation, action and joint state is.
        model: the compiled MjModel.
        decimation: physics steps per control step.
        metrics: names in ``Step.info["metrics"]``.
        fields: name to axes of what a world holds; see `get_field`.
        num_envs, num_agents, action_size, observation_size, state_size: B, N, A, O, S.
    """

    def __init__(
        self,
        definition: Definition,
        num_envs: int,
        seed: int,
        *,
        threads: int = 0,
        autoreset: bool = True,
        compiled: bool = True,
    ) -> None:
        self.definition = definition
        self.spec = spec = definition.spec
        self.layout: TaskLayout = definition.layout
        self.num_envs = num_envs
        self.num_agents = spec.num_agents
        self.action_size = self.layout.action.size
        self.observation_size = self.layout.observation.size
        self.state_size = self.layout.state.size
        self.metrics = (*METRICS, *definition.metrics)
        self.decimation = definition.physics_steps
        self.model = world_model(definition)
        self._options: dict[str, Any] = {"threads": threads, "autoreset": autoreset, "compiled": compiled}
        self._stepper = self._new_stepper()
        self.fields: Mapping[str, tuple[int, ...]] = {
            name: shape for name, (shape, *_) in places(self._stepper.worlds.dtype).items()
        }
        self._terms = (*definition.terms, "physics")
        self._reasons = np.array(definition.reasons)
        # last observations, states and rows of no world
        self._nobody = (
            np.empty((0, self.num_agents, self.observation_size), np.float32),
            np.empty((0, self.state_size), np.float32),
            np.empty((0, self._stepper.sim.rows.shape[1])),
        )
        self._seed = seed
        self._autoreset = autoreset
        self._next_episode = 0
        self._begun = False
        self._waiting = np.ones(num_envs, bool)
        self._any_waiting = True
        self._closed = False
        self._pictures: Any = None

    def __getstate__(self) -> dict[str, Any]:
        """What pickle and deepcopy keep: how it was built, and the worlds as they are."""
        return {
            "built": (self.definition, self.num_envs, self._seed), "options": self._options,
            "rows": self.rows, "waiting": self._waiting, "next_episode": self._next_episode,
            "begun": self._begun, "closed": self._closed,
        }  # fmt: skip

    def __setstate__(self, kept: Mapping[str, Any]) -> None:
        """Resume where the original was."""
        self.__init__(*kept["built"], **kept["options"])
        if kept["begun"]:
            self._stepper.sim.rows[:] = kept["rows"]
            self._look_at_all()
            self._wait(np.array(kept["waiting"]))
        self._next_episode, self._closed = kept["next_episode"], kept["closed"]

    def reset(
        self,
        episode_id: Int[np.ndarray, "n"] | None = None,
        *,
        worlds: Int[np.ndarray, "n"] | None = None,
        seed: int | None = None,
    ) -> Step:
        """Start new episodes.

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
        self._stepper.fresh()
        self._begin(ids, episodes)
        others = np.setdiff1d(np.arange(self.num_envs), ids)
        self._stepper.observe(others)
        waiting = self._waiting.copy()
        waiting[ids] = False
        return self._standing(waiting)

    def step(self, action: Float[np.ndarray, "B N A"]) -> Step:
        """Advance every world by one control step; worlds whose episode ends start their next one.

        Args:
            action: (B, N, A), in [-1, 1]; what lies outside is clipped (where the spec says so), and what
                dead agents are told is ignored.

        Raises:
            ActionError: wrong shape, or a value that is not finite, naming the env and the agent.
        """
        stepper = self._stepper if not self._closed and not self._stepper.sim.lost else self._check_open()
        action = self._checked(action)
        over = stepper.advance(action)
        if over < 0:
            self._refuse_infinite(action)
        if not over:
            return self._told(self._nobody, None)
        results = stepper.results
        reason = results["reason"]
        (ended,) = reason.nonzero()
        last = results.observation[ended], results.state[ended], stepper.sim.rows[ended]
        if self._autoreset:
            self._begin(ended, self._next_episode + np.arange(len(ended)))
        else:
            self._wait(reason > 0)
        return self._told(last, self._reasons[reason])

    @property
    def rows(self) -> Float[np.ndarray, "B R"]:
        """A copy of all worlds: row b is everything that evolves in world b."""
        return self._stepper.sim.rows.copy()

    def load_rows(self, ids: Int[np.ndarray, "n"], rows: Float[np.ndarray, "n R"]) -> Step:
        """Put saved worlds into places ``ids``; return what agents see now, reward 0.

        Raises:
            HipgError: rows of another task, or ids outside 0..B-1 or named twice.
        """
        self._check_open()
        ids = self._checked_worlds(ids)
        rows = self._checked_rows(rows)
        if len(rows) != len(ids):
            self._refuse_rows(rows, len(ids))
        sim = self._stepper.sim
        sim.rows[ids] = rows
        sim.forget_warnings(ids)
        self._next_episode = max(self._next_episode, int(self._stepper.worlds["episode_id"].max()) + 1)
        waiting = self._waiting.copy()
        waiting[ids] = False
        self._look_at_all()
        return self._standing(waiting)

    def fork(self, rows: Float[np.ndarray, "n R"], health: Mapping[int, float]) -> Float[np.ndarray, "n R"]:
        """Return copies of saved worlds in which some agents' health is set: the true counterfactual.

        This is the world that eqn:min_health_baseline of the paper asks about. Health only falls.

        Args:
            rows: saved worlds.
            health: agent to its new health, in [0, 1].

        Raises:
            HipgError: rows of another task, an agent outside 0..N-1, or a health outside [0, 1].
        """
        forked = self._checked_rows(rows).copy()
        worlds = self._records(forked)
        for agent, value in health.items():
            if not (0 <= agent < self.num_agents and 0 <= value <= 1):
                raise HipgError(
                    f"{self.spec.task}: agents 0..{self.num_agents - 1} and health in [0, 1] are allowed, "
                    f"got health[{agent}] = {value}"
                )
            current = worlds["health"][:, agent]
            if value == 0:
                died = current > 0
                worlds["death_time"][died, agent] = worlds["elapsed"][died]
            worlds["health"][:, agent] = np.minimum(current, value)
        return forked

    def get_field(self, name: str, rows: Float[np.ndarray, "n R"] | None = None) -> np.ndarray:
        """A copy of what worlds hold under a name, e.g. ``death_time`` (control steps, `NEVER` while alive).

        Args:
            name: one of `fields`.
            rows: saved worlds; by default those of this environment as they stand.

        Returns:
            (n, *axes) float64, the axes as in `fields`.

        Raises:
            UnknownNameError: no such field.
            HipgError: rows of another task.
        """
        self._check_field(name)
        worlds = self._stepper.worlds if rows is None else self._records(self._checked_rows(rows))
        return worlds[name].copy()

    def set_field(self, rows: Float[np.ndarray, "n R"], name: str, value: Any) -> Float[np.ndarray, "n R"]:
        """Return copies of saved worlds in which a field is set; `load_rows` puts them into an environment.

        Args:
            rows: saved worlds.
            name: one of `fields`.
            value: of shape (n, *axes), or broadcastable to it.

        Raises:
            UnknownNameError: no such field.
            HipgError: rows of another task, or a value of the wrong shape.
        """
        self._check_field(name)
        changed = self._checked_rows(rows).copy()
        array = numbers(value, self.spec.task, whose=f" as {name}")
        expected = (len(changed), *self.fields[name])
        try:
            self._records(changed)[name][...] = array
        except ValueError as error:
            raise HipgError(
                f"{self.spec.task}: {name} of shape {expected} is allowed, got {array.shape}"
            ) from error
        return changed

    def arrange(self, worlds: Int[np.ndarray, "n"] | None = None, **fields: Any) -> Step:
        """Set fields of running worlds, e.g. positions, health or hazards, for a test or a study.

        Args:
            worlds: (n,) which, by default all of them.
            **fields: field name to values of shape (n, *axes), or broadcastable to it.

        Returns:
            What the agents see now, reward 0.

        Raises:
            UnknownNameError: no such field.
            HipgError: worlds outside 0..B-1 or named twice, or values of the wrong shape.
        """
        self._check_open()
        ids = self._checked_worlds(np.arange(self.num_envs) if worlds is None else worlds)
        rows = self._stepper.sim.rows[ids]
        for name, value in fields.items():
            rows = self.set_field(rows, name, value)
        return self.load_rows(ids, rows)

    def render(
        self, world: int = 0, width: int = 640, height: int = 360
    ) -> UInt8[np.ndarray, "height width 3"]:
        """A picture of a world as it stands, drawn in a child process; no display is needed.

        Args:
            world: in 0..B-1.
            width: in pixels, 64 to 4096.
            height: in pixels, 64 to 4096.

        Returns:
            (height, width, 3) uint8; the same world gives the same picture.

        Raises:
            SpecError: no such world, or a size that is not allowed.
            RenderError: no episode has begun, or no OpenGL works here.
        """
        self._check_open()
        task = self.spec.task
        world = whole(world, f"{task}: world", 0, self.num_envs - 1)
        size = whole(width, f"{task}: width", *_PIXELS), whole(height, f"{task}: height", *_PIXELS)
        if not self._begun:
            raise RenderError(f"{task}: nothing to render before reset()")
        if self._pictures is None:
            self._pictures = pkgutil.resolve_name(_PICTURES)(self.spec)
        return self._pictures.picture(self._stepper.sim.rows[world].copy(), size)

    def __repr__(self) -> str:
        """Task, sizes and seed, and where world 0 is."""
        return f"<BatchEnv {', '.join(self._facts())}>"

    def _repr_html_(self) -> str:
        """What a notebook shows: a picture of world 0 and the same facts; without OpenGL the facts only."""
        told = html.escape(", ".join(self._facts()))
        if not self._begun or self._closed:
            return f"<div>{told}</div>"
        try:
            picture = self.render()
        except RenderError as error:
            return f"<div>{told}</div><div>no picture: {html.escape(str(error).splitlines()[0])}</div>"
        png = pkgutil.resolve_name(_PNG)(picture)
        return f'<img src="data:image/png;base64,{png}" width="400" alt="world 0"><div>{told}</div>'

    def _facts(self) -> list[str]:
        threads = self._stepper.sim.threads
        if self._closed:
            world = "closed"
        elif not self._begun:
            world = "not yet reset"
        else:
            first = self._stepper.worlds[0]
            dead = int((first["health"] == 0).sum())
            world = (
                f"world 0: episode {first['episode_id']:.0f} after {first['elapsed']:.0f} steps, {dead} dead"
            )
        return [
            self.spec.task,
            f"num_envs={self.num_envs}",
            f"{self.num_agents} agents",
            f"seed={self._seed}",
            "compiled" if self._options["compiled"] else "not compiled",
            f"{threads} thread{'s' * (threads > 1)}",
            world,
        ]

    def close(self) -> None:
        """Refuse further use."""
        self._closed = True
        if self._pictures is not None:
            self._pictures.close()

    def _begin(self, ids: Int[np.ndarray, "n"], episodes: Int[np.ndarray, "n"]) -> None:
        """Start episodes in worlds ``ids``: all random numbers of an episode are drawn here."""
        if len(ids):
            random = episode.draw(self._seed, episodes, self.definition.num_random)
            self._stepper.begin(ids, episodes, random)
            self._next_episode = max(self._next_episode, int(episodes.max()) + 1)
        self._begun = True

    def _look_at_all(self) -> None:
        """Observe all worlds as they stand."""
        self._stepper.fresh()
        self._stepper.observe(np.arange(self.num_envs))
        self._begun = True

    def _standing(self, waiting: Bool[np.ndarray, "B"]) -> Step:
        """What agents see of worlds that were not stepped, of which some are ``waiting`` for a reset."""
        self._wait(waiting)
        results = self._stepper.results
        for name in ("reward", "terms", "reason", "terminated", "truncated"):
            results[name][...] = 0
        results["metrics"][...] = np.nan
        results["final_alive"][...] = results["alive"]
        return self._told(self._nobody, None)

    def _told(self, last: tuple[np.ndarray, np.ndarray, np.ndarray], end_reason: np.ndarray | None) -> Step:
        """The last call's results as users know them."""
        results = self._stepper.results
        terms, metrics = results["terms"], results["metrics"]
        info: Info = {
            "state": results.state,
            "health": results["health"],
            "alive": results["alive"].view(bool),
            "terms": {name: terms[:, k] for k, name in enumerate(self._terms)},
            "metrics": {name: metrics[:, k] for k, name in enumerate(self.metrics)},
            "end_reason": np.zeros(self.num_envs, "U1") if end_reason is None else end_reason,
            "episode_id": results["episode_id"],
            "elapsed": results["elapsed"],
            "final_alive": results["final_alive"].view(bool),
            "final_observation": last[0],
            "final_state": last[1],
            "final_rows": last[2],
        }
        terminated, truncated = results["terminated"].view(bool), results["truncated"].view(bool)
        return Step(results.observation, results["reward"], terminated, truncated, info)

    def _wait(self, waiting: Bool[np.ndarray, "B"]) -> None:
        self._waiting, self._any_waiting = waiting, bool(waiting.any())

    def _records(self, rows: Float[np.ndarray, "n R"]) -> np.ndarray:
        return rows.view(self._stepper.worlds.dtype)[:, 0]

    def _checked_rows(self, rows: Any) -> Float[np.ndarray, "n R"]:
        array = numbers(rows, self.spec.task, whose=" as rows")
        if array.ndim != 2 or array.shape[1] != self._stepper.sim.rows.shape[1]:
            self._refuse_rows(array, "n")
        return np.ascontiguousarray(array, np.float64)

    def _refuse_rows(self, rows: np.ndarray, count: int | str) -> NoReturn:
        expected = (count, self._stepper.sim.rows.shape[1])
        raise HipgError(f"{self.spec.task}: rows of shape {expected} are allowed, got {rows.shape}")

    def _check_field(self, name: str) -> None:
        if name not in self.fields:
            raise UnknownNameError(f"{self.spec.task}: no field {name!r}{hint(name, self.fields)}")

    def _checked(self, action: Float[np.ndarray, "B N A"]) -> Float[np.ndarray, "B N A"]:
        if not self._begun:
            raise HipgError(f"{self.spec.task}: step() before reset()")
        if self._any_waiting:
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
        return np.ascontiguousarray(action)

    def _refuse_infinite(self, action: Float[np.ndarray, "B N A"]) -> NoReturn:
        """Name a live agent's action that is not finite."""
        bad = (self._stepper.worlds["health"] > 0)[:, :, None] & ~np.isfinite(action)
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

    def _check_open(self) -> Stepper:
        if self._closed:
            raise HipgError(f"{self.spec.task}: this environment is closed")
        if self._stepper.sim.lost:
            rows = self._stepper.sim.rows.copy()
            self._stepper = self._new_stepper()
            if self._begun:
                self._stepper.sim.rows[:] = rows
                self._look_at_all()
        return self._stepper

    def _new_stepper(self) -> Stepper:
        options = self._options
        return Stepper(
            self.definition,
            self.model,
            self.num_envs,
            threads=options["threads"],
            compiled=options["compiled"],
        )


__all__ = ["NEVER", "BatchEnv", "Info", "Step", "world_model"]
