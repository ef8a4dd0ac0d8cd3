"""Decentralised execution is verified by replay: who needs others to act is found out."""

import numpy as np
import pytest
from foreign import TASK, WORKING, A, acting, policy

from hipg_bench.evaluation.decentralised import verify
from hipg_bench.evaluation.episodes import Plan

pytestmark = pytest.mark.skipif(not WORKING, reason="no sandbox works on this machine")
SHORT = TASK.override(horizon=12)

HONEST = {
    "remembers its own observations and counts steps": f"""
        self.sum = observation[..., :{A}] + (self.sum if self.calls > 1 else np.sin(self.calls))
        return np.tanh(self.sum)
    """,
    "has chance of its own": f"""
        if self.calls == 1:
            agents = range(alive.shape[1])
            self.chance = [[np.random.default_rng([seed, i]) for i in agents] for seed in self.seeds]
        return [[one.uniform(-1, 1, {A}) for one in team] for team in self.chance]
    """,
}
SHARING = {
    "acts on its neighbour's": f"return np.tanh(np.roll(observation[..., :{A}], 1, axis=1))",
    "counts agents over all calls": f"""
        self.count = getattr(self, "count", 0) + alive.sum()
        return np.full((*alive.shape, {A}), np.sin(self.count))
    """,
    "acts on another world": f"return np.tanh(observation[::-1, :, :{A}])",
    "talks from the sixth step on": f"""
        own = observation[..., :{A}]
        return np.tanh(own if self.calls < 6 else own[:, ::-1])
    """,
    "fails alone": f"""
        if len(self.seeds) == 1 and self.calls == 3:
            raise RuntimeError("where is everybody?")
        return observation[..., :{A}] * 0
    """,
}


@pytest.mark.parametrize("name", HONEST)
def test_an_agent_that_needs_nobody_else_is_decentralised(tmp_path, name):
    verdict = verify(SHORT, policy(tmp_path, acting(HONEST[name]), spec=SHORT), Plan(threads=1))
    assert verdict.decentralised, str(verdict)
    assert 60 < verdict.compared <= 2 * 4 * 12  # two worlds, four agents, twelve steps, less what died
    assert str(verdict).startswith("decentralised")


@pytest.mark.parametrize("name", SHARING)
def test_an_agent_that_shares_is_found_out(tmp_path, name):
    verdict = verify(SHORT, policy(tmp_path, acting(SHARING[name]), spec=SHORT), Plan(threads=1))
    assert not verdict.decentralised
    assert str(verdict).startswith(f"centralised: {len(verdict.differences)} agents")
    if name == "talks from the sixth step on":
        assert {difference.step for difference in verdict.differences} == {5}
    if name == "fails alone":
        assert {(difference.step, difference.size) for difference in verdict.differences} == {(2, np.inf)}


def test_bits_lost_in_a_batch_are_no_difference(tmp_path):
    body = f"return observation[..., :{A}] * 0 + (0.1 if len(self.seeds) > 1 else 0.1 + 1e-7)"
    assert verify(SHORT, policy(tmp_path, acting(body), spec=SHORT), Plan(threads=1), [0, 1]).decentralised
    body = f"return observation[..., :{A}] * 0 + (0.1 if len(self.seeds) > 1 else 0.101)"
    verdict = verify(SHORT, policy(tmp_path, acting(body), spec=SHORT), Plan(threads=1), [0, 1])
    assert max(difference.size for difference in verdict.differences) == pytest.approx(0.001, abs=2**-16)
