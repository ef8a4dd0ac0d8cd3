"""Decentralised execution is verified by replay: who needs others to act is found out."""

import pytest
from foreign import TASK, WORKING, A, acting, policy

from hipg_bench.evaluation.decentralised import verify
from hipg_bench.evaluation.episodes import EvaluationJob

pytestmark = pytest.mark.skipif(not WORKING, reason="no sandbox works on this machine")
SHORT = TASK.override(horizon=12)
WORLDS = range(8)

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
    "acts on its neighbour's": f"return np.tanh(np.roll(observation[..., 4:{4 + A}], 1, axis=1))",
    "adds up what all observe": f"""
        self.count = getattr(self, "count", 0) + observation.sum()
        return np.full((*alive.shape, {A}), np.sin(self.count))
    """,
    "acts on another world": f"return np.tanh(observation[::-1, :, 4:{4 + A}])",
    "talks from the sixth step on": f"""
        own = observation[..., 4:{4 + A}]
        return np.tanh(own if self.calls < 6 else own[:, ::-1])
    """,
    "shares in large batches only": f"""
        own = observation[..., 4:{4 + A}]
        return np.tanh(own[:, ::-1] if len(alive) > 2 else own)
    """,
}


@pytest.mark.parametrize("name", HONEST)
def test_an_agent_that_needs_nobody_else_is_decentralised(tmp_path, name):
    verdict = verify(
        SHORT, policy(tmp_path, acting(HONEST[name]), spec=SHORT), EvaluationJob(threads=1), WORLDS
    )
    assert verdict.decentralised, str(verdict)
    assert 240 < verdict.compared <= 8 * 4 * 12  # eight worlds, four agents, twelve steps, less what died
    assert str(verdict).startswith("decentralised")


@pytest.mark.parametrize("name", SHARING)
def test_an_agent_that_shares_is_found_out(tmp_path, name):
    verdict = verify(
        SHORT, policy(tmp_path, acting(SHARING[name]), spec=SHORT), EvaluationJob(threads=1), WORLDS
    )
    assert not verdict.decentralised
    assert str(verdict).startswith(f"centralised: {len(verdict.differences)} agents")
    if name == "talks from the sixth step on":
        assert {difference.step for difference in verdict.differences} == {5}


def test_what_cannot_be_compared_is_not_called_decentralised(tmp_path):
    body = "raise RuntimeError('never together')"
    verdict = verify(SHORT, policy(tmp_path, acting(body), spec=SHORT), EvaluationJob(threads=1), WORLDS)
    assert (verdict.decentralised, verdict.compared) == (False, 0)
    assert "nothing could be compared" in str(verdict)
