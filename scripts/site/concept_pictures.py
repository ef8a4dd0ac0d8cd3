"""Draw the pictures of the site's concept pages from real episodes: python scripts/site/concept_pictures.py.

The SVG files in docs/concepts/ are committed; hooks.py puts them into the pages.
"""

from __future__ import annotations

import dataclasses
import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np
import plots
from matplotlib.figure import Figure

import hipg_bench
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.scripted import Scripted

ROOT = Path(__file__).parents[2]
OUT = ROOT / "docs" / "concepts"
BLUE, ORANGE, GREEN, RED = "#2f7ed8", "#e08a1e", "#2a9d6f", "#d0453b"


@dataclasses.dataclass
class Recording:
    """One world, step by step: T + 1 rows, and the actions (T, N, A) that the policy chose."""

    env: hipg_bench.BatchEnv
    rows: np.ndarray
    actions: np.ndarray
    observations: np.ndarray

    def field(self, name: str) -> np.ndarray:
        """(T + 1, ...) what the world held under a name."""
        return self.env.get_field(name, self.rows)


def play(env: hipg_bench.BatchEnv, policy: Any, step: hipg_bench.Step) -> Recording:
    """Let a policy act to the end of the episode in the only world of ``env``."""
    rows, actions, observations, memory = [env.rows[0]], [], [step.observation[0]], None
    if not policy.privileged:
        memory = policy.initial_state(0, step.info["episode_id"], env.num_agents)
    while not (step.terminated | step.truncated).any():
        seen = step.info["state"] if policy.privileged else step.observation
        action, memory = policy.act(seen, memory, step.info["alive"])
        step = env.step(action)
        over = (step.terminated | step.truncated).any()
        rows.append(step.info["final_rows"][0] if over else env.rows[0])
        observations.append(step.info["final_observation"][0] if over else step.observation[0])
        actions.append(action[0])
    return Recording(env, np.array(rows), np.array(actions), np.array(observations))


def recorded(task: str, policy: Any, episode: int) -> Recording:
    """Play one episode of seed 0."""
    env = hipg_bench.make(task, num_envs=1, seed=0, autoreset=False)
    return play(env, policy, env.reset(np.array([episode])))


def health(recording: Recording) -> Figure:
    """Cumulative hazard against the threshold, and health, of a drone that dies and of one that does not."""
    hazard, threshold = recording.field("cumulative_hazard"), recording.field("hazard_threshold")[0]
    life = recording.field("health")
    time = np.arange(len(life)) * recording.env.spec.control_step
    dead = int(np.flatnonzero(life[-1] == 0)[0])
    harmed = np.where(life[-1] > 0, hazard[-1], -1)
    alive = int(harmed.argmax())
    drawn = plots.figure(7.2, 3.9)
    above, below = drawn.subplots(2, 1, sharex=True, height_ratios=[3, 1.2])
    for agent, colour, what, shift in ((dead, RED, "dies", -0.09), (alive, BLUE, "survives", 0.03)):
        above.plot(time, hazard[:, agent], color=colour, linewidth=2)
        above.axhline(threshold[agent], color=colour, linewidth=1.2, linestyle="--")
        above.text(
            time[-1], threshold[agent] + shift, f"threshold of drone {agent}, which {what}", color=colour,
            fontsize=9, ha="right",
        )  # fmt: skip
        below.step(time, life[:, agent], color=colour, linewidth=2, where="post")
    above.set_ylabel("cumulative hazard, nats")
    above.set_ylim(0, 1.25 * max(threshold[dead], threshold[alive], hazard[-1].max()))
    below.set_ylabel("health")
    below.set_yticks([0, 1])
    below.set_ylim(-0.15, 1.15)
    below.set_xlabel("time, s")
    return _clean(drawn)


def death(recording: Recording) -> Figure:
    """What an agent sends, what its motors do, what it observes, before and after its death."""
    life = recording.field("health")
    agent = int(np.flatnonzero(life[-1] == 0)[0])
    last = int(np.argmax(life[:, agent] == 0))
    time = np.arange(len(life)) * recording.env.spec.control_step
    drawn = plots.figure(7.2, 4.6)
    panels = drawn.subplots(5, 1, sharex=True, height_ratios=[1, 1, 1, 0.5, 0.5])
    sent = np.abs(recording.actions[:, agent]).mean(1)
    works = np.abs(recording.field("control")[1:, agent]).mean(1)
    numbers = (recording.observations[:, agent] != 0).sum(1)
    curves = (
        ("action sent", time[:-1], sent, BLUE), ("motors", time[:-1], works, GREEN),
        ("numbers observed", time, numbers, ORANGE),
    )  # fmt: skip
    for axes, (title, moments, values, colour) in zip(panels, curves, strict=False):
        axes.step(moments, values, where="post", color=colour, linewidth=2)
        axes.set_ylim(0, None)
        axes.set_title(title, fontsize=10, loc="left", color=plots.INK)
    for axes, title, end in (
        (panels[3], 'PettingZoo, dead="remove": in env.agents', time[last]),
        (panels[4], 'PettingZoo, dead="ghost", and all APIs of fixed size', time[-1]),
    ):
        axes.axvspan(0, end, color=plots.PALE, alpha=0.45, linewidth=0)
        axes.set_yticks([])
        axes.set_title(title, fontsize=10, loc="left", color=plots.INK)
    for axes in panels:
        axes.axvline(time[last], color=RED, linewidth=1.4, linestyle="--")
    panels[0].text(time[last] + 0.04, 0.75, "dead", color=RED, fontsize=10)
    panels[-1].set_xlabel("time, s")
    panels[-1].set_xlim(0, time[-1])
    return _clean(drawn)


def credit(recording: Recording, policy: Any, at: int) -> Figure:
    """The team from above, with what each drone is worth: the return without it, exactly, by forking."""
    env, rows = recording.env, recording.rows[at : at + 1]
    total = recording.field("episode_return")[-1]
    worth = []
    for agent in range(env.num_agents):
        step = env.load_rows(np.array([0]), env.fork(rows, {agent: 0.0}))
        worth.append(total - play(env, policy, step).field("episode_return")[-1])
    params = env.spec.params
    place, terminal, hazard = _along_the_line(
        *(env.get_field(name, rows)[0] for name in ("position", "terminal", "hazard"))
    )
    alive = env.get_field("health", rows)[0] > 0
    drawn = plots.figure(7.2, 3.6)
    axes = drawn.subplots()
    axes.add_patch(_circle(hazard, params["hazard_radius"], RED))
    nodes = np.concatenate([terminal, place[alive]])
    for a in range(len(nodes)):
        for b in range(max(a + 1, 2), len(nodes)):
            if np.linalg.norm(nodes[a] - nodes[b]) <= params["link_range"]:
                axes.plot(*nodes[[a, b], :2].T, color=plots.PALE, linewidth=1, zorder=1)
    axes.scatter(*terminal[:, :2].T, marker="s", s=90, color=plots.INK, zorder=3)
    largest = max(max(worth), 1.0)
    for agent, (x, y, _) in enumerate(place):
        if not alive[agent]:
            axes.scatter(x, y, marker="x", s=60, color=RED, zorder=4)
            continue
        share = max(worth[agent], 0) / largest
        axes.scatter(x, y, s=60 + 240 * share, color=BLUE, alpha=0.25 + 0.75 * share, zorder=4, linewidths=0)
        axes.annotate(
            f"{worth[agent]:.0f}", (x, y), (0, 10 + 4 * share), textcoords="offset points", ha="center",
            fontsize=10, color=plots.INK,
        )  # fmt: skip
    axes.text(
        hazard[0], hazard[1] - params["hazard_radius"] - 0.03, "hidden hazard, with a wreck", color=RED,
        ha="center", va="top",
    )  # fmt: skip
    axes.set_aspect("equal")
    axes.set_xticks([])
    axes.set_yticks([])
    return _clean(drawn, spines=False)


def protocol(task: str) -> Figure:
    """Returns of published agents, and the scale that turns them into scores."""
    spec = hipg_bench.task_spec(task)
    assert spec.anchors is not None
    drawn = plots.figure(7.2, 3.4)
    axes = drawn.subplots()
    agents = (
        ("random", plots.PALE, 3), ("scripted_blind", ORANGE, 38), ("mappo_minhealth", BLUE, 14),
        ("scripted", GREEN, 3),
    )  # fmt: skip
    for name, colour, above in agents:
        path = ROOT / "leaderboard" / "entries" / name / "standard" / "episodes" / f"{task}.jsonl.gz"
        with gzip.open(path, "rt", encoding="utf-8") as file:
            returns = np.array([json.loads(line)["return"] for line in file])
        counts, edges = np.histogram(returns, bins=np.arange(-50, 0, 1.0))
        axes.stairs(counts, edges, fill=True, color=colour, alpha=0.45)
        axes.stairs(counts, edges, color=colour, linewidth=1.2)
        at = returns.mean()
        text = f"{name}\n{spec.score(at):.2f}"
        axes.text(at, counts.max() + above, text, color=colour, ha="center", fontsize=9)
    low, high = spec.anchors.random.mean, spec.anchors.reference.mean
    scores = axes.secondary_xaxis(
        "top", functions=(lambda x: (x - low) / (high - low), lambda s: low + s * (high - low))
    )
    scores.set_xlabel("score", color=plots.INK)
    scores.set_xticks(np.arange(-0.25, 1.3, 0.25))
    scores.tick_params(colors=plots.INK, labelsize=9)
    scores.spines["top"].set_edgecolor(plots.INK)
    for end in (low, high):
        axes.axvline(end, color=plots.INK, linewidth=0.9, linestyle=":")
    axes.set_xlabel("return of an episode")
    axes.set_ylabel("episodes of 320")
    axes.set_ylim(0, 1.35 * axes.dataLim.ymax)
    return _clean(drawn)


def _along_the_line(
    place: np.ndarray, terminal: np.ndarray, hazard: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Everything turned about the vertical, so that the terminals lie side by side."""
    x, y, _ = terminal[1] - terminal[0]
    angle = np.arctan2(y, x)
    turn = np.array([[np.cos(angle), np.sin(angle), 0], [-np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return place @ turn.T, terminal @ turn.T, hazard @ turn.T


def _circle(centre: np.ndarray, radius: float, colour: str) -> Any:
    from matplotlib.patches import Circle

    return Circle(tuple(centre[:2]), radius, color=colour, alpha=0.2, linewidth=0)


def _clean(drawn: Figure, *, spines: bool = True) -> Figure:
    for axes in drawn.axes:
        axes.spines[["top", "right"]].set_visible(False)
        if not spines:
            axes.spines[["left", "bottom"]].set_visible(False)
    return drawn


def main() -> None:
    """Write all four."""
    blind = Scripted(hipg_bench.task_spec("hazard_nav-4"), blind=True)
    unaware = recorded("hazard_nav-4", blind, 5)
    agent = load_agent("mappo_minhealth")
    aware = recorded("hazard_nav-8", agent.policy(hipg_bench.task_spec("hazard_nav-8")), 13)
    team = agent.policy(hipg_bench.task_spec("hazard_comm-10"))
    relay = recorded("hazard_comm-10", team, 0)
    pictures = {
        "health": (health(aware), "cumulative hazard and health of two drones in one episode"),
        "death": (death(unaware), "what a drone sends, does and observes before and after its death"),
        "credit": (credit(relay, team, 20), "what each relay drone is worth to its team at one moment"),
        "protocol": (protocol("hazard_nav-4"), "returns of four agents and the scale of the score"),
    }
    for name, (drawn, title) in pictures.items():
        (OUT / f"{name}.svg").write_text(plots.to_svg(drawn, title), encoding="utf-8")


if __name__ == "__main__":
    main()
