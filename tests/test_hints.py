"""Which name an error message suggests."""

import pytest

from hipg_bench import tasks
from hipg_bench.errors import hint
from hipg_bench.learning.settings import ALGORITHMS, SYNONYMS
from hipg_bench.policies.bundle import agents


@pytest.mark.parametrize(
    ("name", "allowed", "suggested"),
    [
        ("mapo", agents(), ["mappo_central", "mappo_local", "mappo_minhealth"]),
        ("mapo", [*ALGORITHMS, *SYNONYMS], ["mappo"]),
        ("madpg", agents(), ["maddpg"]),
        ("mappo_minhelth", agents(), ["mappo_minhealth"]),
        ("scriptd", agents(), ["scripted"]),
        ("hazard_nv-4", tasks(), ["hazard_nav-4"]),
        ("multwalker", tasks(), [f"multiwalker{kind}-{n}" for kind in ("", "_planar") for n in (3, 5)]),
        ("minhealth", [*ALGORITHMS, *SYNONYMS], ["min_health"]),
    ],
)
def test_the_nearest_names_are_suggested(name, allowed, suggested):
    said = hint(name, allowed)
    assert said.startswith("; did you mean ")
    assert said.split("'")[1::2] == suggested


def test_a_name_that_is_near_nothing_gets_all_of_them():
    assert hint("xyz", ["b", "aa"]) == "; there are: aa, b"
    assert hint("xyz", []) == "; there are: "
