"""Scripted experts: what a team that knows everything does, and the same team unaware of the hazard.

They act on the joint state, so they are never ranked. They fix the reference anchor of a task, and
the gap between the aware and the hazard-unaware expert is its hazard sensitivity.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import linear_sum_assignment

from hipg_bench.errors import UnknownNameError
from hipg_bench.families.known import declared, lineage
from hipg_bench.layout import TaskLayout
from hipg_bench.registry import definition_of
from hipg_bench.spec import TaskSpec

_CLEARANCE = 0.04
"""How far outside a hazard's radius the aware expert stays, m."""

Places = Float[np.ndarray, "B N D"]  # D is 3 for drones, 2 for the paper's particles


@dataclasses.dataclass(frozen=True)
class Expert:
    """What a family declares as its ``EXPERT``.

    Attributes:
        plan: where agents are to go, from (spec, layout, state, alive, blind).
        stiffness: action per m to go.
        damping: action per m/s of speed.
    """

    plan: Callable[..., Places]
    stiffness: float
    damping: float


class Scripted:
    """The expert for a spec's family.

    Attributes:
        privileged: it acts on the joint state.
    """

    privileged = True

    def __init__(self, spec: TaskSpec, *, blind: bool = False) -> None:
        """Choose the plan of the spec's family.

        Raises:
            UnknownNameError: nobody has written an expert for that family.
        """
        expert: Expert | None = declared(spec.family, "EXPERT")
        if expert is None:
            raise UnknownNameError(f"{spec.task}: family {spec.family!r} declares no scripted EXPERT")
        self._expert = expert
        self._spec = spec
        # a hazard that cannot kill is no reason to keep away
        self._blind = blind or spec.params["hazard_peak"] == 0
        self._layout = definition_of(spec).layout

    def initial_state(self, seed: int, episode_id: Int[np.ndarray, "B"], num_agents: int) -> None:
        """Remember nothing: the state says it all."""

    def act(
        self, state: Float[np.ndarray, "B S"], memory: None, alive: Bool[np.ndarray, "B N"]
    ) -> tuple[Float[np.ndarray, "B N A"], None]:
        """Fly every live drone towards its place in the plan."""
        state = state.astype(np.float64)
        target = self._expert.plan(self._spec, self._layout, state, alive, self._blind)
        position = self._layout.state.view(state, "position")
        velocity = self._layout.state.view(state, "velocity")
        action = self._expert.stiffness * (target - position) - self._expert.damping * velocity
        return (np.clip(action, -1.0, 1.0) if self._spec.clip_actions else action), memory


def _navigate(
    spec: TaskSpec,
    layout: TaskLayout,
    state: Float[np.ndarray, "B S"],
    alive: Bool[np.ndarray, "B N"],
    blind: bool,
) -> Places:
    """Cover every point, hazardous ones from their edge; in the paper's task those earn nothing."""
    position = layout.state.view(state, "position")
    point = layout.state.view(state, "point_position")
    hazardous = layout.state.view(state, "point_hazardous") > 0
    if blind:
        return _assign(position, point, alive)
    margin = spec.params["hazard_radius"] + _CLEARANCE
    # hazards that do not exist are put where nobody passes
    hazard = np.where(hazardous[..., None], point, 1e3)
    if "paper_nav" in lineage(spec.family):
        point = np.where(hazardous[..., None], np.nan, point)
    target = _outside(_assign(position, point, alive), hazard, margin, towards=position)
    return _around(position, target, hazard, margin)


def _relay(
    spec: TaskSpec,
    layout: TaskLayout,
    state: Float[np.ndarray, "B S"],
    alive: Bool[np.ndarray, "B N"],
    blind: bool,
) -> Places:
    """Form an evenly spaced chain between the terminals, around the hazard unless ``blind`` to it."""
    position = layout.state.view(state, "position")
    terminal = layout.state.view(state, "terminal_position")
    hazard = layout.state.view(state, "hazard_position")
    margin = spec.params["hazard_radius"] + _CLEARANCE
    bend = terminal.mean(axis=1) if blind else _bend(terminal, hazard, margin)
    # a spare drone or two near each relay keeps the chain whole when one is lost on the way
    chain = _along(terminal, bend, alive)
    target = _assign(position, chain, alive)
    return target if blind else _around(position, target, hazard[:, None], margin)


DRONES_NAVIGATION, DRONES_RELAY = Expert(_navigate, 6.0, 1.33), Expert(_relay, 6.0, 1.33)
"""Drones with 6 N of thrust and 4 N s/m of drag are critically damped."""
PARTICLES_NAVIGATION, PARTICLES_RELAY = Expert(_navigate, 50.0, 7.5), Expert(_relay, 50.0, 7.5)


def _assign(position: Places, target: Float[np.ndarray, "B P D"], alive: Bool[np.ndarray, "B N"]) -> Places:
    """Give each live drone a target, at the least total distance; the others stay where they are."""
    assigned = position.copy()
    cost = np.linalg.norm(position[:, :, None] - target[:, None], axis=-1)
    for b, live in enumerate(alive):
        here = np.flatnonzero(live)
        usable = np.flatnonzero(np.isfinite(target[b, :, 0]))
        rows, columns = linear_sum_assignment(cost[b][np.ix_(here, usable)])
        assigned[b, here[rows]] = target[b, usable[columns]]
    return assigned


def _outside(target: Places, hazard: Float[np.ndarray, "B P D"], margin: float, towards: Places) -> Places:
    """Move targets that lie in a hazard to its edge, on the side of the drone that is to go there."""
    for k in range(hazard.shape[1]):
        centre = hazard[:, k, None]
        inside = np.linalg.norm(target - centre, axis=-1) < margin
        away = towards - centre
        away = away / np.maximum(np.linalg.norm(away, axis=-1, keepdims=True), 1e-9)
        target = np.where(inside[..., None], centre + margin * away, target)
    return target


def _around(position: Places, target: Places, hazard: Float[np.ndarray, "B P D"], margin: float) -> Places:
    """Replace targets behind a hazard by a waypoint beside it; whoever is inside one leaves it first."""
    aim = target
    for k in range(hazard.shape[1]):
        centre = hazard[:, k, None]
        path = target - position
        length = np.maximum(np.linalg.norm(path, axis=-1, keepdims=True), 1e-9)
        share = np.clip(((centre - position) * path).sum(-1, keepdims=True) / length**2, 0.0, 1.0)
        closest = position + share * path - centre
        gap = np.linalg.norm(closest, axis=-1, keepdims=True)
        blocked = (gap < margin - 1e-6) & (share > 0) & (share < 1)
        aim = np.where(blocked, centre + 1.15 * margin * closest / np.maximum(gap, 1e-9), aim)
        out = position - centre
        depth = np.linalg.norm(out, axis=-1, keepdims=True)
        aim = np.where(
            depth < margin - 2 * _CLEARANCE, centre + 1.3 * margin * out / np.maximum(depth, 1e-9), aim
        )
    return aim


def _bend(
    terminal: Float[np.ndarray, "B 2 D"], hazard: Float[np.ndarray, "B D"], margin: float
) -> Float[np.ndarray, "B D"]:
    """The corner of the shortest two-legged horizontal path between the terminals that clears the hazard."""
    line = terminal[:, 1] - terminal[:, 0]
    line = line / np.linalg.norm(line, axis=-1, keepdims=True)
    side = np.zeros_like(line)
    side[:, 0], side[:, 1] = -line[:, 1], line[:, 0]
    middle = terminal.mean(axis=1)
    off = hazard - middle
    # bend to the side the hazard is not on
    side = np.where((off * side).sum(-1, keepdims=True) > 0, -side, side)
    foot = middle + (off * line).sum(-1, keepdims=True) * line
    corner = foot
    for reach in np.linspace(0.9, 0.0, 37):
        candidate = foot + reach * side
        clear = np.minimum(
            _gap_to_leg(terminal[:, 0], candidate, hazard), _gap_to_leg(candidate, terminal[:, 1], hazard)
        )
        corner = np.where((clear >= margin)[:, None], candidate, corner)
    return corner


def _gap_to_leg(
    start: Float[np.ndarray, "B D"], end: Float[np.ndarray, "B D"], point: Float[np.ndarray, "B D"]
) -> Float[np.ndarray, "B"]:
    """Distance from a point to the segment start-end."""
    leg = end - start
    share = np.clip(((point - start) * leg).sum(-1) / np.maximum((leg * leg).sum(-1), 1e-9), 0.0, 1.0)
    return np.linalg.norm(start + share[:, None] * leg - point, axis=-1)


def _along(
    terminal: Float[np.ndarray, "B 2 D"], bend: Float[np.ndarray, "B D"], alive: Bool[np.ndarray, "B N"]
) -> Float[np.ndarray, "B N D"]:
    """Evenly spaced relay places on the path terminal-bend-terminal, one per live drone; NaN beyond."""
    first = np.linalg.norm(bend - terminal[:, 0], axis=-1)[:, None]
    second = np.linalg.norm(terminal[:, 1] - bend, axis=-1)[:, None]
    live = alive.sum(axis=1, keepdims=True)
    number = np.arange(1, alive.shape[1] + 1)[None]
    at = np.where(number <= live, number / (live + 1) * (first + second), np.nan)
    early, late = (at / first)[..., None], ((at - first) / second)[..., None]
    on_first = terminal[:, None, 0] + early * (bend - terminal[:, 0])[:, None]
    on_second = bend[:, None] + late * (terminal[:, 1] - bend)[:, None]
    return np.where((at <= first)[..., None], on_first, on_second)
