"""What a run shows elsewhere: TensorBoard's event files, and wandb in its offline mode."""

import sys
import types

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from hipg_bench.errors import HipgError, UnknownNameError
from hipg_bench.learning.run import train
from hipg_bench.learning.settings import recommended
from hipg_bench.learning.trackers import Service, open_trackers, tag

SETTINGS = recommended("coop_nav-3", steps=96, num_envs=4, rollout=8, eval_every=64)


def test_tags_are_grouped():
    assert tag("score") == "evaluation/score"
    assert tag("eval_return") == "evaluation/return"
    assert tag("kl") == "learner/kl"
    assert tag("return") == "episodes/return"


def test_tensorboard_has_values_over_environment_steps_and_hyperparameters(tmp_path):
    logged = {}
    train(SETTINGS, tmp_path, command="", report=lambda iteration, log: logged.update({32 * iteration: log}))
    board = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    points = board.Scalars("learner/value_loss")
    assert [point.step for point in points] == [32, 64, 96]
    assert [point.value for point in points] == pytest.approx([log["value_loss"] for log in logged.values()])
    assert [point.step for point in board.Scalars("evaluation/return")] == [64, 96]
    assert all("/" in name for name in board.Tags()["scalars"])
    assert "_hparams_/session_start_info" in board.summary_metadata
    start = board.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    assert b"num_envs" in start
    assert b"coop_nav-3" in start


def test_a_resumed_run_repeats_no_point(tmp_path):
    train(SETTINGS, tmp_path, command="")
    more = SETTINGS.model_copy(update={"steps": 160})
    train(more, tmp_path, command="")
    board = EventAccumulator(str(tmp_path / "tensorboard")).Reload()
    assert [point.step for point in board.Scalars("learner/value_loss")] == [32, 64, 96, 128, 160]


def test_wandb_offline(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    monkeypatch.setenv("WANDB_SILENT", "true")
    train(SETTINGS, tmp_path, command="", track=("wandb",))
    (file,) = (tmp_path / "wandb").glob("offline-run-*/run-*.wandb")
    content = file.read_bytes()
    for part in (b"evaluation/score", b"learner/value_loss", b"num_envs", b"coop_nav-3"):
        assert part in content


@pytest.mark.parametrize("name", ["wandb", "trackio"])
def test_services_get_the_settings_and_every_value_over_steps(name, tmp_path, monkeypatch):
    calls = []
    fake = types.SimpleNamespace(
        init=lambda **options: calls.append(("init", options)),
        log=lambda values, step: calls.append(("log", values, step)),
        finish=lambda: calls.append(("finish",)),
    )
    monkeypatch.setitem(sys.modules, name, fake)
    settings = {"task": "coop_nav-3", "algorithm": "min_health", "seed": 0}
    for _ in range(2):
        service = Service(name, tmp_path, settings)
        service.log({"learner/kl": 0.5}, 32)
        service.close()
    assert calls[1:3] == [("log", {"learner/kl": 0.5}, 32), ("finish",)]
    options = calls[0][1]
    assert (options["config"], options["resume"]) == (settings, "allow")
    assert calls[3] == calls[0], "the same folder is the same run"
    other = Service(name, tmp_path / "other", settings)
    other.close()
    assert calls[-2][1] != options


def test_what_is_unknown_or_missing_is_told_before_training(tmp_path, monkeypatch):
    with pytest.raises(UnknownNameError, match="did you mean 'wandb'"):
        train(SETTINGS, tmp_path / "a", command="", track=("wandd",))
    assert not (tmp_path / "a").exists()
    monkeypatch.setitem(sys.modules, "trackio", None)
    with pytest.raises(HipgError, match=r"pip install 'hipg-bench\[trackio\]'"):
        open_trackers(("trackio",), tmp_path, {"task": "", "algorithm": "", "seed": 0}, 0)
