"""From a task of one's own to a trained, evaluated policy: what the commands take, say and refuse."""

import json
import os
import stat
from pathlib import Path

import pytest
from typer.testing import CliRunner

import hipg_bench
from hipg_bench import registry
from hipg_bench.cli import app
from hipg_bench.cli.tasks import copy
from hipg_bench.errors import BundleError, HipgError, ResumeError, SpecError, UnknownNameError
from hipg_bench.paths import data_folder
from hipg_bench.policies.trained import find_agent

SMALL = ("--steps", "64", "--set", "num_envs=4", "--set", "rollout=8")


@pytest.fixture(autouse=True)
def own_tasks(monkeypatch, tmp_path):
    """Tasks that a test adds are known in that test only; it works in a folder of its own."""
    monkeypatch.setattr(registry, "_added", {})
    monkeypatch.chdir(tmp_path)


def run(*args):
    """The output of a command that must succeed."""
    done = CliRunner().invoke(app, [str(arg) for arg in args], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def test_a_varied_task_has_a_name_of_its_own_and_no_anchors():
    spec = hipg_bench.task_spec("hazard_nav-4")
    varied = registry.vary(spec, num_agents=3, hazard_peak=0.25)
    assert varied.task == "hazard_nav-4_hazard_peak-0-25_num_agents-3"
    assert (varied.num_agents, varied.params["hazard_peak"], varied.anchors) == (3, 0.25, None)
    assert hipg_bench.make(varied.task, 2).num_agents == 3
    assert varied.task not in registry.tasks()
    assert registry.vary(spec, horizon=spec.horizon) is spec
    with pytest.raises(SpecError, match="did you mean 'hazard_peak'"):
        registry.vary(spec, hazrd_peak=1.0)


def test_two_tasks_cannot_share_a_name(tmp_path):
    copy("coop_nav-3", Path("mine.toml"))
    first = hipg_bench.read_task("mine.toml")
    assert first.model_copy(update={"task": "coop_nav-3"}).fingerprint == (
        hipg_bench.task_spec("coop_nav-3").fingerprint
    )
    text = (tmp_path / "mine.toml").read_text()
    (tmp_path / "mine.toml").write_text(text.replace("horizon = ", "horizon = 1"))
    with pytest.raises(SpecError, match="another task of this name"):
        hipg_bench.read_task("mine.toml")
    (tmp_path / "coop_nav-3.toml").write_text(text.replace('"mine"', '"coop_nav-3"').replace("= 3", "= 4"))
    with pytest.raises(SpecError, match="another task of this name"):
        hipg_bench.read_task("coop_nav-3.toml")
    with pytest.raises(SpecError, match="it exists"):
        copy("coop_nav-3", Path("mine.toml"))


def test_every_bundled_task_survives_being_written(tmp_path):
    from hipg_bench.spec import load, to_toml

    for name, spec in registry.tasks().items():
        path = tmp_path / f"{name}.toml"
        path.write_text(to_toml(spec))
        assert load(path).model_dump(exclude={"anchors", "calibration"}) == spec.model_dump(
            exclude={"anchors", "calibration"}
        )


def test_own_task_trained_evaluated_calibrated(tmp_path):
    copy("hazard_nav-4", Path("mine.toml"), num_agents=2)
    said = run("train", "--task", "mine.toml", *SMALL)
    folder = tmp_path / "runs" / "mine-min_health-seed0"
    assert f"hipg-bench evaluate --agent {folder.relative_to(tmp_path)} --task mine.toml" in said
    assert "hipg-bench calibrate mine.toml --write" in said
    again = run("train", "--task", "mine.toml", *SMALL)
    assert "finished already" in again
    # everything that a run leaves may be read by whom the umask lets
    plain = tmp_path / "plain"
    plain.touch()
    for name in ("policy.safetensors", "learner.safetensors", "train.json", "curve.csv", "checkpoint.pt"):
        assert stat.S_IMODE((folder / name).stat().st_mode) == stat.S_IMODE(plain.stat().st_mode), name

    # another process knows nothing of the task but what the run tells
    registry._added.clear()
    args = ("--episodes", 2, "--threads", 1, "--video", 0)
    said = run("evaluate", "--agent", folder, *args, "--out", "scores")
    assert "no score on mine" in said
    (row,) = json.loads((tmp_path / "scores" / "results.json").read_text())["tasks"]
    assert (row["task"], row["num_agents"], row["score"], row["train_seeds"]) == ("mine", 2, None, [0])

    run("calibrate", "mine.toml", "--episodes", 2, "--threads", 1, "--write")
    registry._added.clear()
    said = run("evaluate", "--agent", folder, "--task", "mine.toml", *args, "--out", "scored")
    assert "no score on" not in said
    (row,) = json.loads((tmp_path / "scored" / "results.json").read_text())["tasks"]
    assert row["score"] == pytest.approx(hipg_bench.task_spec("mine").score(row["return_mean"]))

    # the same name with other numbers is another task
    registry._added.clear()
    text = (tmp_path / "mine.toml").read_text()
    (tmp_path / "mine.toml").write_text(text.replace("horizon = 50", "horizon = 40"))
    with pytest.raises(HipgError, match="another task of this name"):
        run("train", "--task", "mine.toml", *SMALL, "--steps", 96)


def test_a_run_and_a_policy_file_are_agents(tmp_path):
    run("train", "--task", "coop_nav-3", *SMALL, "--seed", 7, "--out", "a run", "--set", "initial_std=0.4")
    agent = find_agent("a run")
    assert (agent.name, agent.tasks, agent.train_seeds("coop_nav-3")) == ("a_run", ("coop_nav-3",), (7,))
    alone = find_agent("a run/policy.safetensors")
    assert alone.fingerprint("coop_nav-3", 7) == agent.fingerprint("coop_nav-3", 7)
    with pytest.raises(BundleError, match="its network"):
        agent.policy(hipg_bench.task_spec("multiwalker-3"), 7)

    weights = data_folder("agents") / "mappo_minhealth" / "hazard_comm-10" / "seed0.safetensors"
    bundled = find_agent(weights)
    assert (bundled.name, bundled.tasks) == ("hazard_comm_10_seed0", ("hazard_comm-10",))
    # observations do not grow with the team on these tasks
    varied = registry.vary(hipg_bench.task_spec("hazard_comm-10"), num_agents=9)
    said = run(
        "evaluate", "--agent", weights, "--task", "hazard_comm-10", "--num-agents", 9, "--episodes", 1,
        "--video", 0, "--threads", 1, "--out", "nine",
    )  # fmt: skip
    assert varied.task in said


@pytest.mark.parametrize(
    ("name", "error", "message"),
    [
        ("mappo_minhelth", UnknownNameError, "did you mean 'mappo_minhealth'"),
        ("runs/none", UnknownNameError, "no such file or folder"),
        ("empty", BundleError, "neither an agent's agent.toml nor a training run's train.json"),
        ("graph.onnx", BundleError, "submit init"),
        ("begun", BundleError, "holds no policy.safetensors yet"),
        ("old", BundleError, "train again"),
    ],
)
def test_what_is_no_agent_is_told_in_a_line(tmp_path, name, error, message):
    (tmp_path / "empty").mkdir()
    (tmp_path / "graph.onnx").touch()
    spec = hipg_bench.task_spec("coop_nav-3")
    record = {
        "command": "", "task": spec.task, "task_fingerprint": spec.fingerprint, "settings": {"seed": 0},
        "env_steps": 0, "seconds": 0.0,
    }  # fmt: skip
    for folder, changes in (("begun", {}), ("old", {"task_fingerprint": "0" * 12})):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "train.json").write_text(json.dumps(record | changes))
    with pytest.raises(error, match=message):
        find_agent(name)


def test_training_settings_and_task_numbers_are_told_apart(tmp_path):
    run("train", "--task", "coop_nav-3", *SMALL, "--set", "horizon=20", "--set", "gamma=0.5", "--out", "run")
    record = json.loads((tmp_path / "run" / "train.json").read_text())
    assert record["settings"]["gamma"] == 0.5
    assert (record["task"], record["spec"]["horizon"]) == ("coop_nav-3_horizon-20", 20)
    assert "--set horizon=20 --set gamma=0.5" in record["command"]
    for pair, near in (("gama=0.5", "gamma"), ("horzon=5", "horizon")):
        with pytest.raises(SpecError, match=f"did you mean '{near}'"):
            run("train", "--task", "coop_nav-3", *SMALL, "--set", pair)
    with pytest.raises(ResumeError, match="not coop_nav-3: choose another --out"):
        run("train", "--task", "coop_nav-3", *SMALL, "--out", "run")


def test_every_tag_that_tasks_lists_can_be_evaluated():
    from hipg_bench.cli.evaluate import suite_of

    for tag in {tag for spec in registry.tasks().values() for tag in spec.tags}:
        assert [spec.task for spec in suite_of(tag).specs] == list(registry.tagged(tag))


def test_version():
    assert run("--version").split() == ["hipg-bench", hipg_bench.__version__]


def test_modes_follow_the_umask(tmp_path):
    from hipg_bench.paths import replacing

    before = os.umask(0o027)
    try:
        with replacing(tmp_path / "file") as temporary:
            os.close(os.open(temporary, os.O_CREAT | os.O_WRONLY, 0o600))
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "file").stat().st_mode) == 0o640
