"""Laws that every task obeys, checked on random play with casualties."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from play import flat, outcomes, play, same

import hipg_bench
from hipg_bench import BatchEnv, Step, TaskSpec, make

TASKS = sorted(hipg_bench.tasks())
WORLDS = 24
STEPS = 40
EVENTS = ("first_link", "chain")
HORIZON = 30  # short episodes, so that a recording holds whole ones and what follows them


@dataclasses.dataclass(frozen=True)
class Recording:
    env: BatchEnv
    first: Step
    steps: list[Step]

    @property
    def pairs(self) -> list[tuple[Step, Step]]:
        """Every step with the one before it."""
        return list(zip([self.first, *self.steps[:-1]], self.steps, strict=True))


def short(task: str, num_envs: int, *, seed: int = 0, threads: int = 1) -> BatchEnv:
    return make(task, num_envs, seed, threads=threads, horizon=HORIZON)


@pytest.fixture(scope="module", params=TASKS)
def recording(request: pytest.FixtureRequest) -> Recording:
    env = short(request.param, WORLDS)
    first = env.reset()
    return Recording(env, first, play(env, first, STEPS))


def test_arrays_are_finite_and_as_declared(recording: Recording):
    env = recording.env
    b, n, names = env.num_envs, env.num_agents, {*env.spec.weights, "physics"}
    expected = {
        "observation": ((b, n, env.observation_size), np.float32),
        "reward": ((b,), np.float64),
        "terminated": ((b,), np.bool_),
        "truncated": ((b,), np.bool_),
        "info.state": ((b, env.state_size), np.float32),
        "info.health": ((b, n), np.float64),
        "info.alive": ((b, n), np.bool_),
        "info.final_alive": ((b, n), np.bool_),
        "info.episode_id": ((b,), np.int64),
        "info.elapsed": ((b,), np.int64),
        **{f"info.terms.{name}": ((b,), np.float64) for name in names},
    }
    for step in [recording.first, *recording.steps]:
        arrays, ended = flat(step), int((step.terminated | step.truncated).sum())
        final = {
            "info.final_observation": ((ended, n, env.observation_size), np.float32),
            "info.final_state": ((ended, env.state_size), np.float32),
            "info.final_rows": ((ended, env.rows.shape[1]), np.float64),
        }
        for name, (shape, kind) in {**expected, **final}.items():
            assert (arrays[name].shape, arrays[name].dtype) == (shape, kind), name
            assert np.isfinite(arrays[name]).all(), name
        assert set(step.info["terms"]) == names
        assert arrays.keys() == flat(recording.first).keys(), "every step tells of the same things"
        assert step.info["end_reason"].shape == (b,)
    assert env.layout.observation.size == env.observation_size
    assert env.layout.state.size == env.state_size
    assert env.model.nu >= n


def test_terms_sum_to_the_reward(recording: Recording):
    for step in recording.steps:
        total = sum(step.info["terms"].values())
        np.testing.assert_allclose(total, step.reward, rtol=1e-12, atol=1e-12)


def test_health_never_rises(recording: Recording):
    deaths = 0
    for was, now in recording.pairs:
        goes_on = ~(now.terminated | now.truncated)
        assert (now.info["health"][goes_on] <= was.info["health"][goes_on]).all()
        assert (now.info["health"] >= 0).all()
        assert (now.info["health"] <= 1).all()
        assert same(now.info["alive"], now.info["health"] > 0)
        assert (now.info["final_alive"] <= was.info["alive"]).all() or (now.info["elapsed"] == 0).any()
        deaths += int((was.info["alive"][goes_on] & ~now.info["alive"][goes_on]).sum())
    dead = np.stack([~step.info["final_alive"] for step in recording.steps])
    assert dead.any(), "nobody died: this recording shows nothing"


def test_the_dead_see_only_their_own_health(recording: Recording):
    layout = recording.env.layout
    blind = np.zeros(layout.observation.size, np.float32)
    blind[layout.observation.slices[layout.health_block]] = layout.dead_value
    for step in recording.steps:
        for observation, alive in (
            (step.observation, step.info["alive"]),
            (step.info["final_observation"], step.info["final_alive"][step.terminated | step.truncated]),
        ):
            assert (observation[~alive] == blind).all()
        columns = step.info["state"][:, layout.health_columns]
        assert ((columns == layout.dead_value) == ~step.info["alive"]).all()


def test_truncation_is_not_termination(recording: Recording):
    ended = 0
    for was, now in recording.pairs:
        assert not (now.terminated & now.truncated).any()
        at_horizon = was.info["elapsed"] + 1 == HORIZON
        assert same(now.truncated, at_horizon & ~now.terminated)
        assert same(now.info["end_reason"] == "horizon", now.truncated)
        assert same(now.info["end_reason"] != "", now.terminated | now.truncated)
        ended += int(now.terminated.sum() + now.truncated.sum())
    assert ended >= WORLDS


def test_metrics_tell_of_ended_episodes_and_of_nothing_else(recording: Recording):
    total = np.zeros(WORLDS)
    for was, now in recording.pairs:
        total += now.reward
        done = now.terminated | now.truncated
        metrics = now.info["metrics"]
        for name in ("return", "length", "survival", "deaths", *recording.env.definition.metrics):
            # what tells of an event is undefined where it never happened
            assert name in EVENTS or np.isfinite(metrics[name][done]).all(), name
            assert np.isnan(metrics[name][~done]).all(), name
        dead = (~now.info["final_alive"]).sum(axis=1)
        np.testing.assert_allclose(metrics["return"][done], total[done], rtol=1e-9, atol=1e-9)
        assert same(metrics["length"][done], was.info["elapsed"][done] + 1.0)
        assert same(metrics["deaths"][done], dead[done].astype(float))
        np.testing.assert_allclose(metrics["survival"][done], 1 - dead[done] / recording.env.num_agents)
        assert same(np.isfinite(metrics["first_death"][done]), dead[done] > 0)
        assert (metrics["return"][done] > recording.env.spec.floor).all(), "the floor must be below all play"
        total = np.where(done, 0.0, total)


def test_an_ended_episode_gives_way_to_a_fresh_one(recording: Recording):
    env = recording.env
    begun = recording.first.info["episode_id"].tolist()
    for was, now in recording.pairs:
        done = now.terminated | now.truncated
        assert same(now.info["episode_id"][~done], was.info["episode_id"][~done])
        assert same(now.info["elapsed"], np.where(done, 0, was.info["elapsed"] + 1))
        assert (now.info["health"][done] == 1).all()
        begun += now.info["episode_id"][done].tolist()
        if done.any():
            last, ids = now, np.flatnonzero(done)
    assert sorted(begun) == list(range(len(begun))), "every episode is begun once, none is left out"
    fresh = short(env.spec.task, len(ids)).reset(last.info["episode_id"][ids])
    assert same(fresh.observation, last.observation[ids])
    assert same(fresh.info["state"], last.info["state"][ids])


@pytest.mark.parametrize(("order", "threads"), [([5], 1), ([7, 2, 4], 2), ([*range(30, 0, -1)], 7)])
def test_results_depend_on_seed_and_episode_alone(recording: Recording, order: list[int], threads: int):
    known = outcomes(recording.env, recording.first, recording.steps)
    env = short(recording.env.spec.task, len(order), threads=threads)
    first = env.reset(np.array(order))
    met = outcomes(env, first, play(env, first, 20))
    shared = known.keys() & met.keys()
    assert len(shared) >= min(20, 8 * len(order))
    for key in shared:
        for name, value in known[key].items():
            assert same(value, met[key][name]), (key, name)


@pytest.mark.parametrize("task", TASKS)
def test_results_depend_on_it_alone_in_larger_teams_too(task: str):
    """Sums of eight and more numbers are where NumPy's order of adding comes to depend on the batch."""
    size = {"num_agents": 9, "horizon": 10}
    env, one = make(task, 7, threads=1, **size), make(task, 1, threads=1, **size)
    first, alone = env.reset(), one.reset(np.array([5]))
    known, met = outcomes(env, first, play(env, first, 10)), outcomes(one, alone, play(one, alone, 10))
    shared = known.keys() & met.keys()
    assert (5, 5) in shared
    for key in shared:
        for name, value in known[key].items():
            assert same(value, met[key][name]), (key, name)


def test_another_seed_is_another_world(recording: Recording):
    other = short(recording.env.spec.task, WORLDS, seed=1).reset()
    assert not (other.info["state"] == recording.first.info["state"]).all(axis=1).any()


def test_starts_vary(recording: Recording):
    starts = np.concatenate([
        recording.first.info["state"],
        *(step.info["state"][step.info["elapsed"] == 0] for step in recording.steps),
    ])  # fmt: skip
    assert len(starts) > WORLDS
    assert len(np.unique(starts, axis=0)) == len(starts)


def constants(spec: TaskSpec) -> dict[str, str]:
    """Blocks and elements of the observation and the state that may be constant, and why."""
    n, allowed = spec.num_agents, dict[str, str]()
    by_place = "points are exchangeable: the critic knows the hazards by their place"
    if spec.family == "hazard_comm":
        allowed |= dict.fromkeys(("state.terminal_position[2]", "state.terminal_position[5]"), "fixed height")
    if spec.family == "hazard_nav":
        allowed |= dict.fromkeys(("state.point_hazardous", "state.point_revealed"), by_place)
    if "paper" in spec.tags:
        allowed["previous_terminated"] = "who lives was alive before, and the dead see nothing"
        allowed["state.marker_hazardous"] = by_place
        listed = ("dead_position", "previous_dead_position")
        beyond = [f"{name}[{i}]" for name in listed for i in range(2 * (n - 1), 10)]
        allowed |= dict.fromkeys(beyond, "five slots in teams of any size, as the authors have it")
    if spec.params.get("hazards") == 0:
        kinds = ("point_hazardous", "hazard_position")
        flags = [prefix + kind for prefix in ("", "previous_", "state.") for kind in kinds]
        allowed |= dict.fromkeys(flags, "no hazards in this task")
    return allowed


def ravaged(task: str) -> tuple[BatchEnv, list[Step]]:
    """Many short episodes of steady pushes in which anything from nobody to nearly all is killed."""
    walkers = hipg_bench.task_spec(task).family == "multiwalker"
    worlds, rng = 32 if walkers else 256, np.random.default_rng(0)
    env = make(task, worlds, threads=1, horizon=20)
    steps = [env.reset()]
    for t in range(40):
        if t % 20 == 0:
            push = rng.uniform(-1, 1, (worlds, env.num_agents, env.action_size))
        if t % 20 in (3, 9):
            for ids in np.array_split(np.arange(worlds), 16):
                victims = rng.choice(env.num_agents, rng.integers(0, env.num_agents), replace=False)
                rows = env.fork(env.rows[ids], dict.fromkeys(victims.tolist(), 0.0))
                steps.append(env.load_rows(ids, rows))
        steps.append(env.step(push + rng.normal(0, 0.3, push.shape)))
    return env, steps


@pytest.mark.parametrize("task", TASKS)
def test_no_element_is_constant(task: str):
    env, steps = ravaged(task)
    allowed = constants(env.spec)
    # quantities of the published joint state that are always 0 say so in the layout itself
    allowed |= {
        f"state.{b.name}": b.visible for b in env.layout.state.blocks if b.visible.startswith("never")
    }
    seen = np.concatenate([step.observation.reshape(-1, env.observation_size) for step in steps])
    state = np.concatenate([step.info["state"] for step in steps])
    dull = [
        f"{prefix}{name}[{i}]"
        for prefix, layout, values in (
            ("", env.layout.observation, seen),
            ("state.", env.layout.state, state),
        )
        for name, columns in layout.slices.items()
        for i, spread in enumerate(np.ptp(values[:, columns], axis=0))
        if spread == 0 and not {prefix + name, f"{prefix}{name}[{i}]"} & allowed.keys()
    ]
    assert not dull, dull


def test_what_is_returned_is_the_callers_to_keep(recording: Recording):
    """Scribbling over everything returned changes nothing, and no two arrays share memory."""
    task = recording.env.spec.task
    env, undisturbed = short(task, 3), short(task, 3)
    spoiled, clean = env.reset(), undisturbed.reset()
    kept: list[np.ndarray] = []
    for t in range(HORIZON + 2):
        arrays = flat(spoiled)
        for name, array in arrays.items():
            assert array.size == 0 or array.flags.writeable, name
            assert not any(np.shares_memory(array, other) for other in kept), name
            kept.append(array)
        kept = kept[-2 * len(arrays) :]
        rows = env.rows
        for array in [*arrays.values(), rows]:
            array.fill("x" if array.dtype.kind == "U" else 1)
        action = np.sin(np.arange(3 * env.num_agents * env.action_size) + t)
        action = action.reshape(3, env.num_agents, env.action_size)
        spoiled, clean = env.step(action.copy()), undisturbed.step(action)
        for name, value in flat(clean).items():
            assert same(value, flat(spoiled)[name]), name
