"""Worlds in which an agent was killed, so that the critic meets what the min-health baseline asks it about.

The baseline needs V(s with only h_i := 0) at the states of the rollout, for every agent that lives in them.
Policies avoid such states, and those who do die are not those the question is about: a scout lost at the
hazard costs the team little, a drone torn from its post much. Here some worlds run beside the rollout's; each
is a copy of one of them at some moment, with one of its live agents killed. The same policy plays on in it,
the critic learns from it by the same value targets, and the actor does not.

Killing agents in the rollout's own worlds (`Settings.spontaneous_deaths`) teaches the critic of such states
too, but then V(s) of a whole team counts in that somebody will soon be struck, which in the task nobody is.
"""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from hipg_bench.env import BatchEnv, Step
from hipg_bench.learning.gae import gae
from hipg_bench.learning.networks import Actor, Critic
from hipg_bench.learning.settings import Settings
from hipg_bench.registry import make

_LIFE = 5
"""Mean steps until a fork is overwritten by a fresh one, unless its episode ends before."""


class Forks:
    """F worlds beside the rollout's.

    Attributes:
        env: the worlds. None goes on where its episode ended: another fork takes its place.
        step: what is seen in them now.
    """

    def __init__(self, settings: Settings, worlds: BatchEnv) -> None:
        """Fork worlds as they stand."""
        self.settings = settings
        count = max(1, round(settings.forks * settings.num_envs))
        self.env = make(
            settings.task,
            count,
            settings.seed,
            threads=torch.get_num_threads(),
            autoreset=False,  # a step's state is the one that it led to
            weights=settings.weights,
        )
        self.step: Step = self.env.reset()
        self._renew(np.ones(count, bool), worlds)
        self._seen: list[dict[str, Tensor]] = []

    @torch.no_grad()
    def play(self, actor: Actor, worlds: BatchEnv) -> None:
        """One step of every fork, remembered; then fresh forks of ``worlds`` where one is due."""
        env, was = self.env, self.step
        now = env.step(actor(torch.from_numpy(was.observation)).sample().numpy())
        over = now.terminated | now.truncated
        due = over | (torch.rand(env.num_envs) < 1 / _LIFE).numpy()
        self._seen.append({
            "state": torch.from_numpy(was.info["state"]),
            "elapsed": torch.from_numpy(was.info["elapsed"]).float() / env.spec.horizon,
            "reward": torch.from_numpy(now.reward).float(),
            "ended": torch.from_numpy(now.terminated if self.settings.bootstrap_truncation else over),
            "done": torch.from_numpy(due),
            "next_state": torch.from_numpy(now.info["state"]),
        })  # fmt: skip
        self.step = now
        if due.any():
            self._renew(due, worlds)

    @torch.no_grad()
    def harvest(
        self, critic: Critic
    ) -> tuple[Float[Tensor, "T F S"], Float[Tensor, "T F"], Float[Tensor, "T F"]]:
        """States, their share of the horizon and value targets since last time."""
        data = {name: torch.stack([seen[name] for seen in self._seen]) for name in self._seen[0]}
        self._seen = []
        elapsed, settings = data["elapsed"], self.settings
        value = critic(data["state"], elapsed)
        next_value = critic(data["next_state"], elapsed + 1 / self.env.spec.horizon)
        advantage = gae(
            data["reward"],
            value,
            next_value,
            data["ended"],
            data["done"],
            settings.gamma,
            settings.gae_lambda,
        )
        return data["state"], elapsed, value + advantage

    def go_on(self, rows: Float[np.ndarray, "F R"]) -> None:
        """Continue from the rows of a checkpoint."""
        self.step = self.env.load_rows(np.arange(self.env.num_envs), rows)

    def _renew(self, due: Bool[np.ndarray, "F"], worlds: BatchEnv) -> None:
        """Put forks of random worlds, each without one random agent, into the places that are due."""
        places = np.flatnonzero(due)
        rows = worlds.rows[torch.randint(worlds.num_envs, (len(places),)).numpy()]
        alive = worlds.recall(rows, "health") > 0
        victim = (torch.rand(alive.shape).numpy() * alive).argmax(axis=1)
        for agent in range(worlds.num_agents):
            struck = victim == agent
            rows[struck] = worlds.fork(rows[struck], {agent: 0.0})
        self.step = self.env.load_rows(places, rows)
