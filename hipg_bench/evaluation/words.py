"""What the names in rows mean, for people who read reports and pages."""

from __future__ import annotations

from collections.abc import Mapping

END_REASONS: Mapping[str, str] = {
    "horizon": "time was up",
    "physics": "the physics diverged",
    "dropped": "the plank was dropped",
    "all_fallen": "all had fallen",
    "all_dead": "all were dead",
}
"""Why episodes end; other reasons are shown as they are."""

METRICS: Mapping[str, str] = {
    "covered": "distance from a point to the nearest live agent, m",
    "collisions": "contacts between agents, per episode",
    "revealed": "hazards that became known to the team",
    "connected": "share of steps in which the terminals were linked",
    "first_link": "control step in which the terminals were first linked",
    "chain": "relays in the shortest chain between the terminals",
    "displacement": "way of the plank, m",
    "slip": "way that the plank slid over the walkers' heads, m",
    "carriers": "walkers alive at the end",
    "tipped": "walkers that fell by tipping over",
    "sunk": "walkers that fell by sinking down",
    "deaths_hazard": "deaths by a hazard",
    "deaths_collision": "deaths by a collision",
}
"""What the families' metrics are, means over episodes; ``dropped`` is told by the end reasons already."""


def end_reason(name: str) -> str:
    """Why an episode ended, in words."""
    return END_REASONS.get(name, name.replace("_", " "))


def metric(name: str) -> str:
    """What a metric is, in words."""
    return METRICS.get(name, name.replace("_", " "))
