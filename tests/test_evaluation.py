"""The protocol: rows depend on task, policy and world alone; reports are computed from rows."""

import dataclasses
import html.parser
import json
import tomllib

import imageio.v3
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hipg_bench import make, task_spec
from hipg_bench.errors import BundleError, HipgError, ResumeError
from hipg_bench.evaluation import calibration, films, report, runner
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.evaluation.results import aggregate, summarise
from hipg_bench.paths import PARTIAL, data_folder
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.simple import Constant, Random
from hipg_bench.rendering import gl
from hipg_bench.spec import Anchor, Anchors, load

TASK = "hazard_nav-4"


def anchored(spec, low=-40.0, high=-10.0):
    random, reference = (Anchor(mean=mean, ci95=(mean, mean), episodes=1) for mean in (low, high))
    return spec.model_copy(update={"anchors": Anchors(random=random, reference=reference)})


@given(st.integers(0, 300), st.integers(1, 100), st.sets(st.integers(0, 300)))
def test_batches_cover_what_is_left_once_and_in_order(episodes, num_envs, done):
    batches = list(EvaluationJob(seed=7, episodes=episodes, num_envs=num_envs).batches(done))
    assert [world for batch in batches for world in batch] == [k for k in range(episodes) if k not in done]
    for batch in batches:
        assert 1 <= len(batch) <= num_envs
        assert len({world // 64 for world in batch}) == 1


def test_rows_are_what_a_plain_loop_over_single_worlds_sees():
    """Worlds of two evaluation seeds, each played alone, deaths read off the health step by step."""
    spec, policy = task_spec(TASK), load_agent("scripted_blind").policy(task_spec(TASK))
    rows = EvaluationJob(seed=3, episodes=70, threads=1).play_all(spec, policy)
    assert [row["world"] for row in rows] == list(range(70))
    assert sum(row["deaths"] for row in rows) > 20
    for world in (0, 1, 2, 63, 64, 69):
        seed, episode = 3 + world // 64, world % 64
        env = make(TASK, 1, seed, threads=1)
        step = env.reset(np.array([episode]))
        memory, total, deaths, length = policy.initial_state(seed, np.array([episode]), 4), 0.0, [], 0
        while not (step.terminated | step.truncated)[0]:
            alive = step.info["alive"]
            action, memory = policy.act(step.info["state"], memory, alive)
            step = env.step(action)
            total, length = total + step.reward[0], length + 1
            died = np.flatnonzero(alive[0] & ~step.info["final_alive"][0])
            deaths += [{"agent": int(i), "time": round(length * 0.1, 6), "cause": "hazard"} for i in died]
        row = rows[world]
        assert (row["eval_seed"], row["episode_id"], row["length"]) == (seed, episode, length)
        assert row["return"] == pytest.approx(total, abs=1e-9)
        assert row["death_list"] == deaths
        assert row["deaths"] == len(deaths)
        assert row["survival"] == 1 - len(deaths) / 4
        assert row["first_death"] == (deaths[0]["time"] if deaths else None)
        assert row["end_reason"] == "horizon"


@pytest.mark.parametrize(("num_envs", "threads"), [(1, 1), (7, 2), (64, 2), (1000, 1)])
def test_rows_do_not_depend_on_batch_and_threads(num_envs, threads):
    spec = task_spec(TASK).override(horizon=15)
    for name in ("random", "scripted_blind"):
        policy = load_agent(name).policy(spec)
        expected = EvaluationJob(episodes=66, num_envs=64, threads=1).play_all(spec, policy)
        rows = EvaluationJob(episodes=66, num_envs=num_envs, threads=threads).play_all(spec, policy)
        assert sum(row["deaths"] for row in rows) > 0
        assert json.dumps(rows) == json.dumps(expected)


def test_early_ends_count_first_episodes_only():
    """Dropped planks end episodes at different times; no world's second episode gets in."""
    spec = task_spec("multiwalker-3")
    rows = EvaluationJob(episodes=12, num_envs=12, threads=1).play_all(spec, Random(6))
    assert len({row["length"] for row in rows}) > 3
    assert [row["episode_id"] for row in rows] == list(range(12))
    alone = EvaluationJob(episodes=12, num_envs=1, threads=1).play_all(spec, Random(6))
    assert json.dumps(rows) == json.dumps(alone)


class Monstrous(Constant):
    """Forces whose accelerations MuJoCo refuses, on a task that does not clip actions."""

    def act(self, seen, memory, alive):
        return np.full((*alive.shape, self._action_size), 9e9), memory


def test_broken_physics_is_scored_at_the_floor():
    spec = anchored(task_spec("paper_nav-4"))
    rows = EvaluationJob(episodes=3, threads=1).play_all(spec, Monstrous(2))
    assert [row["end_reason"] for row in rows] == ["physics"] * 3
    assert [row["return"] for row in rows] == pytest.approx([spec.floor] * 3)
    summary = summarise(spec, [row | {"train_seed": 0} for row in rows])
    assert summary["score"] == pytest.approx((spec.floor + 40) / 30)
    assert summary["end_reasons"] == {"physics": 3}


def test_an_episode_played_again_alone_is_the_same():
    spec, policy = task_spec(TASK), load_agent("scripted_blind").policy(task_spec(TASK))
    job = EvaluationJob(episodes=66, threads=1)
    row = job.play_all(spec, policy)[65]
    states = job.record(spec, policy, row)
    assert len(states) == row["length"] + 1
    env = make(TASK)
    np.testing.assert_array_equal(env.get_field("elapsed", states), np.arange(51))
    with pytest.raises(HipgError, match="played again"):
        job.record(spec, policy, row | {"reached": row["reached"] + 1e-9})


class PlugError(Exception):
    pass


def stop_after(episodes):
    """A progress callback that pulls the plug."""
    done = 0.0

    def progress(stage, more):
        nonlocal done
        done += more
        if done > episodes:
            raise PlugError

    return progress


def suite(*tasks):
    return runner.Suite("custom", tuple(task_spec(task) for task in tasks))


def test_interrupted_and_resumed_gives_the_same_bytes(tmp_path):
    agent, tasks, job = (
        load_agent("scripted_blind"),
        suite(TASK, "coop_nav-3"),
        EvaluationJob(episodes=80, num_envs=9, threads=1),
    )
    runner.evaluate(agent, tasks, tmp_path / "whole", job)
    for stop in (30, 75, 100):
        with pytest.raises(PlugError):
            runner.evaluate(agent, tasks, tmp_path / "parts", job, progress=stop_after(stop))
        assert not list((tmp_path / "parts").rglob(f"{PARTIAL}*"))
    # resumed with another batch size, too
    runner.evaluate(agent, tasks, tmp_path / "parts", dataclasses.replace(job, num_envs=64))
    for task in (TASK, "coop_nav-3"):
        name = f"episodes/{task}.jsonl"
        assert (tmp_path / "parts" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    before, after = (json.loads((tmp_path / run / "results.json").read_text()) for run in ("whole", "parts"))
    assert {**before, "timing": 0} == {**after, "timing": 0}


def test_a_longer_evaluation_extends_a_shorter_one(tmp_path):
    agent = load_agent("zero")
    runner.evaluate(agent, suite(TASK), tmp_path / "a", EvaluationJob(episodes=5, threads=1))
    runner.evaluate(agent, suite(TASK), tmp_path / "a", EvaluationJob(episodes=9, threads=1))
    runner.evaluate(agent, suite(TASK), tmp_path / "b", EvaluationJob(episodes=9, threads=1))
    name = f"episodes/{TASK}.jsonl"
    assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


def test_a_folder_of_another_evaluation_is_refused(tmp_path):
    job, zero = EvaluationJob(episodes=4, threads=1), load_agent("zero")
    runner.evaluate(zero, suite(TASK), tmp_path, job)
    rows = (tmp_path / f"episodes/{TASK}.jsonl").read_bytes()
    with pytest.raises(ResumeError, match="agent is 'zero' there and 'random' here"):
        runner.evaluate(load_agent("random"), suite(TASK), tmp_path, job)
    with pytest.raises(ResumeError, match="seed is 1000 there and 1 here"):
        runner.evaluate(zero, suite(TASK), tmp_path, dataclasses.replace(job, seed=1))
    with pytest.raises(ResumeError, match="world is 3 there and 'below 3' here"):
        runner.evaluate(zero, suite(TASK), tmp_path, dataclasses.replace(job, episodes=3))
    harder = runner.Suite("custom", (task_spec(TASK).override(hazard_peak=0.9),))
    with pytest.raises(ResumeError, match="fingerprint"):
        runner.evaluate(zero, harder, tmp_path, job)
    assert (tmp_path / f"episodes/{TASK}.jsonl").read_bytes() == rows


def test_results_are_computed_from_the_rows(tmp_path):
    tasks = runner.Suite("custom", (anchored(task_spec(TASK)), anchored(task_spec("multiwalker-3"))))
    results = runner.evaluate(
        load_agent("scripted_blind"), tasks, tmp_path, EvaluationJob(episodes=70, threads=1)
    )
    assert json.loads((tmp_path / "results.json").read_text()) == json.loads(json.dumps(results))
    rows = [json.loads(line) for line in (tmp_path / f"episodes/{TASK}.jsonl").read_text().splitlines()]
    (task,) = results["tasks"]
    returns = np.array([row["return"] for row in rows])
    assert (results["schema"], results["suite"], results["agent"]) == (2, "custom", "scripted_blind")
    assert (task["task"], task["version"], task["episodes"]) == (TASK, task_spec(TASK).version, 70)
    assert task["return_mean"] == pytest.approx(returns.mean())
    assert task["score"] == pytest.approx((returns.mean() + 40) / 30)
    low, high = task["return_ci95"]
    # the normal approximation of the interval, to a tenth of its width
    error = 1.96 * returns.std() / np.sqrt(70)
    assert np.allclose([low, high], [returns.mean() - error, returns.mean() + error], atol=0.2 * error)
    assert task["score_ci95"] == pytest.approx([(low + 40) / 30, (high + 40) / 30])
    assert task["deaths"] == pytest.approx(np.mean([len(row["death_list"]) for row in rows]))
    assert task["survival"] == pytest.approx(1 - task["deaths"] / 4)
    assert task["end_reasons"] == {"horizon": 70}
    assert task["death_causes"] == {"hazard": sum(row["deaths"] for row in rows)}
    assert results["skipped"] == [{"task": "multiwalker-3", "reason": "no policy for this task"}]
    # of two tasks one is unplayed: it counts as 0, and the mean of the middle half of two is their mean
    assert results["aggregate"]["score_iqm"] == pytest.approx(task["score"] / 2)
    assert results["aggregate"]["counted_as_zero"] == 1


def test_tasks_without_anchors_are_left_out_of_the_aggregate():
    bare = task_spec(TASK).model_copy(update={"anchors": None})
    # scores 0.5 and 0.7 between anchors at -40 and -10
    rows = [{"train_seed": 0, "status": "ok", "return": value} for value in (-25.0, -19.0)]
    assert aggregate([(bare, rows)])["score_iqm"] is None
    whole = aggregate([(bare, rows), (anchored(task_spec(TASK)), rows)])
    assert (whole["tasks"], whole["score_iqm"]) == (1, pytest.approx(0.6))


def test_an_agent_that_plays_nothing_is_an_error(tmp_path):
    with pytest.raises(BundleError, match="plays none of these tasks"):
        runner.evaluate(
            load_agent("scripted"), suite("multiwalker-3"), tmp_path / "out", EvaluationJob(episodes=1)
        )
    assert not (tmp_path / "out").exists()


def test_films_are_of_the_median_then_from_worst_to_best(tmp_path):
    spec, agent, job = task_spec(TASK), load_agent("random"), EvaluationJob(episodes=21, threads=1)
    rows = [row | {"train_seed": 0} for row in job.play_all(spec, agent.policy(spec))]
    chosen = films.choose(agent, spec, rows, job, 3, tmp_path)
    returns = np.sort([row["return"] for row in rows])
    assert [film.file for film in chosen] == [f"videos/{TASK}{end}.mp4" for end in ("", "-q000", "-q100")]
    env = make(TASK)
    filmed = [env.get_field("episode_return", np.load(film.saved)["rows"][-1:])[0] for film in chosen]
    assert filmed == [returns[10], returns[0], returns[-1]]
    # a longer evaluation has another median episode: its film replaces the old one, and only that
    for film in chosen:
        film.video.parent.mkdir(exist_ok=True)
        film.video.write_bytes(b"film")
    extra = [{**rows[0], "world": 100 + k, "return": returns[-1], "train_seed": 1} for k in range(2)]
    films.choose(agent, spec, rows + extra, job, 3, tmp_path)
    assert [film.video.exists() for film in chosen] == [True, True, True]
    fewer = [row for row in rows if row["return"] > returns[4]]
    films.choose(agent, spec, fewer, job, 3, tmp_path)
    assert [film.video.exists() for film in chosen] == [False, False, True]


@pytest.mark.skipif(gl.working_backend() is None, reason="no OpenGL here")
def test_an_evaluation_has_a_film_of_the_median_episode(tmp_path):
    short = runner.Suite("custom", (task_spec(TASK).override(horizon=2),))
    stages = []
    results = runner.evaluate(
        load_agent("random"), short, tmp_path, EvaluationJob(episodes=3, threads=1), films_per_task=1,
        progress=lambda stage, done: stages.append((stage, done)),
    )  # fmt: skip
    assert results["film_trouble"] == []
    assert [film["file"] for film in results["films"]] == [f"videos/{TASK}.mp4"]
    frame = imageio.v3.imread(tmp_path / f"videos/{TASK}.mp4", index=0)
    assert frame.shape == (540, 960, 3)
    assert frame.std() > 5
    assert f'src="videos/{TASK}.mp4"' in (tmp_path / "report.html").read_text()
    assert sum(done for stage, done in stages if stage == "films") == pytest.approx(1)
    assert sum(done for stage, done in stages if stage == TASK) == pytest.approx(3)


class Links(html.parser.HTMLParser):
    """Everything a page would load, and its text."""

    def __init__(self):
        super().__init__()
        self.loads, self.tags, self.text = [], [], ""

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.loads += [value for name, value in attrs if name in ("src", "href")]

    def handle_data(self, data):
        self.text += data


def test_the_report_opens_offline_and_trusts_no_name(tmp_path):
    folder = tmp_path / "evil"
    folder.mkdir()
    summary = "<script>alert(1)</script>"
    (folder / "agent.toml").write_text(f'name = "evil"\nsummary = "{summary}"\nbuiltin = "scripted_blind"\n')
    tasks = runner.Suite(
        "custom", (anchored(task_spec(TASK)), task_spec("coop_nav-3"), task_spec("multiwalker-3"))
    )
    results = runner.evaluate(
        load_agent(folder), tasks, tmp_path / "out", EvaluationJob(episodes=20, threads=1)
    )
    results["films"] = [{"task": TASK, "file": f"videos/{TASK}.mp4", "title": "the median"}]
    specs = {spec.task: spec for spec in tasks.specs[:2]}
    rows = {
        task: [
            json.loads(line) for line in (tmp_path / f"out/episodes/{task}.jsonl").read_text().splitlines()
        ]
        for task in specs
    }
    page = Links()
    page.feed(report.render(results, rows, specs))
    assert "script" not in page.tags
    assert summary in page.text
    assert set(page.loads) == {f"videos/{TASK}.mp4", f"#{TASK}", "#coop_nav-3"}
    # bars of the returns' distribution are as high as their counts: 20 episodes in all
    drawn = report._returns(specs[TASK], rows[TASK])
    assert sum(int(bar.says.split()[0]) for bar in drawn.bars) == 20
    for task in (TASK, "coop_nav-3", "multiwalker-3"):
        assert task in page.text


def test_calibration_measures_what_the_rows_say():
    spec = task_spec(TASK).override(horizon=20)
    measured = calibration.calibrate(spec, 64, threads=1, progress=lambda name, done: None)
    job = EvaluationJob(10_000, 64, threads=1)
    random = [row["return"] for row in job.play_all(spec, Random(3))]
    expert = [row["return"] for row in job.play_all(spec, load_agent("scripted").policy(spec))]
    anchors, facts = measured.spec.anchors, measured.spec.calibration
    assert anchors.random.mean == pytest.approx(np.mean(random), abs=1e-3)
    assert anchors.reference.mean == pytest.approx(np.mean(expert), abs=1e-3)
    blind = np.mean([row["return"] for row in job.play_all(spec, load_agent("scripted_blind").policy(spec))])
    safe_spec = spec.override(hazard_peak=0.0)
    safe = job.play_all(safe_spec, load_agent("scripted_blind").policy(safe_spec))
    assert sum(row["deaths"] for row in safe) == 0
    gap = np.mean(expert) - np.mean(random)
    leverage = (np.mean([row["return"] for row in safe]) - blind) / gap
    assert facts["hazard_sensitivity"] == pytest.approx(leverage, abs=1e-3)
    assert 0 < facts["random_deaths"] < 1
    assert all(facts[f"score_{probe}"] < 0.5 for probe in ("zero", "constant", "time_only"))


def test_the_reference_of_multiwalker_is_stated():
    spec = task_spec("multiwalker-3")
    anchor, says = calibration._stated(spec)
    # the plank carried for the whole episode at the highest rewarded speed
    metres = spec.params["speed_cap"] * spec.horizon * spec.control_step
    assert anchor.mean == pytest.approx(metres * spec.weights["progress"])
    assert "stated" in says


def test_writing_a_calibration_keeps_the_rest_of_the_file(tmp_path):
    path = tmp_path / f"{TASK}.toml"
    original = (data_folder("tasks") / f"{TASK}.toml").read_text()
    bare = original.split("[anchors]")[0].rstrip() + "\n"
    path.write_text(bare)
    spec = anchored(load(path)).model_copy(update={"calibration": {"hazard_sensitivity": 0.3}})
    calibration.write(spec, path)
    first = path.read_text()
    assert first.startswith(bare)
    assert load(path).anchors == spec.anchors
    assert load(path).calibration == {"hazard_sensitivity": 0.3}
    assert load(path).fingerprint == spec.fingerprint
    calibration.write(spec, path)
    assert path.read_text() == first
    # sections elsewhere than at the end, subsections, and what follows them
    path.write_text(
        "[anchors.random]\nmean = 1\n# gone\n\n[params]\nx = 1 # kept\n[calibration]\na = 1\n[[anchors]]\n"
    )
    assert tomllib.loads(calibration._without(path.read_text(), ("anchors", "calibration"))) == {
        "params": {"x": 1}
    }


def test_scores_are_told_and_written_before_films_and_survive_an_interruption(tmp_path, monkeypatch):
    spec = task_spec("coop_nav-3")
    told = []

    def film(*args, **kwargs):
        results = json.loads((tmp_path / "results.json").read_text())
        told.append(("film", len(results["tasks"])))
        raise KeyboardInterrupt

    monkeypatch.setattr("hipg_bench.rendering.film.record", film)
    with pytest.raises(KeyboardInterrupt):
        runner.evaluate(
            load_agent("zero"), runner.Suite("custom", (spec,)), tmp_path,
            EvaluationJob(episodes=2, threads=1),
            films_per_task=1,
            played_task=lambda task: told.append(("task", task["task"])),
            scored=lambda results: told.append(("scored", results["aggregate"]["tasks"])),
        )  # fmt: skip
    assert told == [("task", "coop_nav-3"), ("scored", 1), ("film", 1)]
    results = json.loads((tmp_path / "results.json").read_text())
    assert (results["films"], results["film_trouble"]) == ([], ["interrupted"])
    assert "interrupted" in (tmp_path / "report.html").read_text()


def test_marks_of_a_histogram_tell_their_own_value():
    """Not that of the axis' end, which stood below the word before."""
    spec = task_spec("coop_nav-3")
    rows = [{"return": value} for value in (-41.0, -20.0, -1.6)]
    drawn = report._returns(spec, rows)
    values = {mark.label: mark.value for mark in drawn.marks}
    assert values == {
        "random": f"{spec.anchors.random.mean:.1f}", "reference": f"{spec.anchors.reference.mean:.1f}",
        "mean": "-20.9",
    }  # fmt: skip
    assert drawn.high == "-1.6"
    # each stands where its value is on the axis
    low, high = float(drawn.low), float(drawn.high)
    for mark in drawn.marks:
        assert mark.x / 360 == pytest.approx((float(mark.value) - low) / (high - low), abs=0.01)
