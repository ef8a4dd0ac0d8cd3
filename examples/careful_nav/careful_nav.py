"""An example of your own family: hazard navigation in which every lost drone costs the team.

What is not said here it has from its parent: world, rules, observations, films, expert, evaluation splits.
`try_it.py` registers it for one process. ``--plugin examples/careful_nav/careful_nav.py`` makes it known to
one command, such as ``hipg-bench train --task examples/careful_nav/careful_nav-5.toml``. Once it is
installed, by ``pip install examples/careful_nav``, it is known to all.
"""

from __future__ import annotations

from hipg_bench.families import hazard_nav
from hipg_bench.families.family import Previous

PARENT = "hazard_nav"


class Terms(hazard_nav.Terms):
    """Parts of the team reward, before weights."""

    lost: float  # drones that died in the step


def reward(
    w: hazard_nav.World,
    previous: Previous,
    scratch: hazard_nav.Scratch,
    task: hazard_nav.Numbers,
    terms: Terms,
) -> None:
    """Charge for uncovered points, collisions and losses; the task file has the weights."""
    hazard_nav.reward(w, previous, scratch, task, terms)
    terms.lost = 0.0
    for i in range(len(w.health)):
        if w.health[i] == 0 and previous.health[i] > 0:
            terms.lost += 1.0
