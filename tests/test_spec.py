"""Task specs: what is refused and how, what an override changes, what the fingerprint covers."""

from __future__ import annotations

import json
import tomllib
from pathlib import Path

import numpy as np
import pytest

import hipg_bench
from hipg_bench import make, task_spec
from hipg_bench.errors import HipgError, SpecError, UnknownNameError
from hipg_bench.paths import data_folder
from hipg_bench.spec import Anchor, Anchors, TaskSpec, load, parse

TASKS = sorted(hipg_bench.tasks())


@pytest.fixture
def spec() -> TaskSpec:
    """A task with anchors: random play returns -60, the reference -20."""
    anchors = Anchors(
        random=Anchor(mean=-60, ci95=(-61, -59), episodes=1000),
        reference=Anchor(mean=-20, ci95=(-21, -19), episodes=1000),
    )
    return task_spec("hazard_nav-4").model_copy(update={"anchors": anchors})


@pytest.mark.parametrize(
    ("change", "parts"),
    [
        ({"num_agents": 1}, ("num_agents", "1", "2")),
        ({"num_agents": 32}, ("num_agents", "32", "31")),
        ({"num_agents": 2.5}, ("num_agents", "2.5")),
        ({"horizon": 0}, ("horizon", "0", "1")),
        ({"control_step": -0.1}, ("control_step", "-0.1", "0")),
        ({"num_agent": 5}, ("'num_agent'", "did you mean 'num_agents'?")),
        ({"hazard_radios": 0.2}, ("'hazard_radios'", "did you mean 'hazard_radius'?")),
        ({"hazard_peak": 1.0}, ("hazard_peak", "1.0", "less than 1")),
        ({"hazard_radius": "wide"}, ("hazard_radius", "'wide'", "number")),
        ({"weights": {"distances": 1.0}}, ("'distances'", "did you mean 'distance'?")),
        ({"weights": {"distance": "far"}}, ("distance", "'far'")),
        ({"version": 3}, ("'version'",)),
    ],
    ids=str,
)
def test_an_impossible_override_is_refused(change: dict[str, object], parts: tuple[str, ...]):
    with pytest.raises(SpecError) as refusal:
        make("hazard_nav-4", **change)  # pyright: ignore[reportArgumentType]
    for part in ("hazard_nav-4", *parts):
        assert part in str(refusal.value)


def test_an_unknown_task_is_answered_with_the_nearest():
    with pytest.raises(UnknownNameError, match=r"did you mean 'hazard_nav-4'\?"):
        make("hazard-nav-4")


@pytest.mark.parametrize(("num_envs", "seed"), [(0, 0), (-3, 0), (1, -1)])
def test_impossible_batches_are_refused(num_envs: int, seed: int):
    with pytest.raises(SpecError, match="is refused: a whole number"):
        make("hazard_nav-4", num_envs, seed)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("num_agents", [2, 31])
def test_any_number_of_agents_from_2_to_31(task: str, num_agents: int):
    if task_spec(task).family == "multiwalker" and num_agents == 31:
        num_agents = 8  # compiling 31 walkers takes long and shows nothing else
    env = make(task, 1, threads=1, num_agents=num_agents)
    step = env.reset()
    assert step.observation.shape == (1, num_agents, env.observation_size)
    rest = np.zeros((1, num_agents, env.action_size))
    assert env.step(rest).reward.shape == (1,)


def test_the_score_is_0_at_random_and_1_at_the_reference(spec: TaskSpec):
    # -60 and -20 are the anchors; -40 lies half way, -10 a quarter of the scale beyond
    assert [spec.score(r) for r in (-60, -40, -20, -10)] == [0, 0.5, 1, 1.25]


def test_an_override_drops_the_anchors_it_invalidates(spec: TaskSpec):
    changed = spec.override(hazard_radius=0.2)
    assert changed.anchors is None
    assert changed.calibration == {}
    assert changed.params["hazard_radius"] == 0.2
    assert spec.params["hazard_radius"] != 0.2, "a spec never changes"
    with pytest.raises(SpecError, match="has no anchors"):
        changed.score(-30)
    assert spec.override(horizon=spec.horizon).anchors == spec.anchors


def test_weights_are_changed_one_by_one(spec: TaskSpec):
    changed = spec.override(weights={"collision": -5})
    assert changed.weights == {**spec.weights, "collision": -5}


@pytest.mark.parametrize("task", TASKS)
def test_the_fingerprint_covers_behaviour_and_nothing_else(task: str):
    spec = task_spec(task)
    prose = {"summary": "other words", "tags": ("mine",), "anchors": None, "calibration": {"leverage": 0.5}}
    assert spec.model_copy(update=prose).fingerprint == spec.fingerprint
    behaviour = {
        "task": "another", "version": spec.version + 1, "num_agents": spec.num_agents + 1,
        "horizon": spec.horizon + 1, "control_step": spec.control_step * 2, "floor": spec.floor - 1,
        "clip_actions": not spec.clip_actions, "graded_health": not spec.graded_health,
        "weights": {name: weight + 1 for name, weight in spec.weights.items()},
        **{f"params.{name}": {**spec.params, name: 0.123456} for name in spec.params},
    }  # fmt: skip
    prints = {spec.fingerprint}
    for field, value in behaviour.items():
        prints.add(spec.model_copy(update={field.partition(".")[0]: value}).fingerprint)
    assert len(prints) == 1 + len(behaviour)
    assert len(spec.fingerprint) == 12


@pytest.mark.parametrize("task", TASKS)
def test_a_task_survives_json(task: str):
    spec = task_spec(task)
    assert parse(TaskSpec, json.loads(spec.model_dump_json()), task) == spec


def spoil(tmp_path: Path, before: str, after: str) -> Path:
    text = (data_folder("tasks") / "hazard_nav-4.toml").read_text()
    assert before in text
    path = tmp_path / "hazard_nav-4.toml"
    path.write_text(text.replace(before, after, 1))
    return path


@pytest.mark.parametrize(
    ("before", "after", "parts"),
    [
        ("horizon", "horizons", ("horizons", "did you mean 'horizon'?")),
        ("num_agents = 4", "num_agents = 40", ("num_agents", "40", "31")),
        ("num_agents = 4", "", ("num_agents", "required")),
        ('task = "hazard_nav-4"', 'task = "other-4"', ("other-4", "named after its task")),
        ("[params]", "[params", ("hazard_nav-4.toml", "line")),
    ],
    ids=str,
)
def test_a_spoilt_file_is_refused(tmp_path: Path, before: str, after: str, parts: tuple[str, ...]):
    path = spoil(tmp_path, before, after)
    with pytest.raises(SpecError) as refusal:
        load(path)
    for part in parts:
        assert part in str(refusal.value)


def test_an_unknown_family_number_is_refused(tmp_path: Path):
    path = spoil(tmp_path, "hazard_peak", "hazard_peek")
    with pytest.raises(HipgError, match=r"hazard_peek.*did you mean 'hazard_peak'"):
        make(load(path))


def test_the_suites_are_as_announced():
    families = {"hazard_nav": (4, 8), "hazard_comm": (10, 16), "multiwalker": (3, 5), "coop_nav": (3,)}
    standard = {f"{family}-{n}" for family, sizes in families.items() for n in sizes}
    assert set(hipg_bench.tagged("standard")) == standard
    for name in TASKS:
        spec = task_spec(name)
        assert name.endswith(f"-{spec.num_agents}")
        with (data_folder("tasks") / f"{name}.toml").open("rb") as file:
            assert tomllib.load(file)["task"] == name
