"""Published runs can be run again from the repository alone."""

import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hipg_bench.cli import app
from hipg_bench.comparison.reproduce import published
from hipg_bench.errors import BundleError
from hipg_bench.learning.run import train
from hipg_bench.learning.settings import recommended
from hipg_bench.paths import data_folder
from hipg_bench.policies.bundle import load_agent
from hipg_bench.submissions.init import init

RECORDS = sorted(data_folder("agents").glob("*/*/seed*.json"))


@pytest.mark.parametrize("path", RECORDS, ids=lambda path: "/".join(path.parts[-3:]))
def test_every_published_run_has_all_that_it_began_with(path):
    record = json.loads(path.read_text())
    run = published(load_agent(path.parts[-3]), path.parts[-2], int(path.stem[4:]))
    settings = run.settings
    # what is run again is what was run, to the step
    assert settings.iterations * settings.num_envs * settings.rollout == record["env_steps"]
    assert (settings.task, settings.seed) == (path.parts[-2], int(path.stem[4:]))
    initial = getattr(settings, "initial_policy", None)
    assert bool(initial) == bool(record["settings"].get("initial_policy"))
    if initial:
        assert Path(initial).is_relative_to(data_folder("agents"))
        assert Path(initial).is_file()


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    """An agent of one short run, with its record."""
    folder = tmp_path_factory.mktemp("published")
    settings = recommended("coop_nav-3", steps=200, num_envs=4, rollout=50, seed=2)
    train(settings, folder / "run", command="somewhere else --out /tmp/gone")
    init(folder / "mine", 0, authors="A", license="MIT", runs=[folder / "run"])
    return folder / "mine"


def test_a_run_comes_out_the_same_on_one_machine(bundle, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    args = ["reproduce", str(bundle), "coop_nav-3", "2"]
    done = CliRunner().invoke(app, args, catch_exceptions=False)
    assert done.exit_code == 0
    assert "the policy is the published one, byte for byte" in done.output
    assert (tmp_path / "runs" / "reproduce-mine-coop_nav-3-seed2" / "policy.safetensors").is_file()
    shown = CliRunner().invoke(app, [*args, "--show"], catch_exceptions=False).output
    assert json.loads(shown[shown.index("{") :])["steps"] == 200


def test_what_cannot_be_repeated_is_told(bundle, tmp_path):
    with pytest.raises(BundleError, match="no record of a run on coop_nav-3 with seed 5; did you mean"):
        published(load_agent(bundle), "coop_nav-3", 5)
    shutil.copytree(bundle, tmp_path / "mine")
    path = tmp_path / "mine" / "coop_nav-3" / "seed2.json"
    record = json.loads(path.read_text())
    record["settings"]["initial_policy"] = "/tmp/gone.safetensors"
    path.write_text(json.dumps(record))
    with pytest.raises(BundleError, match=r"began with /tmp/gone.safetensors"):
        published(load_agent(tmp_path / "mine"), "coop_nav-3", 2)
    shutil.copyfile(path.with_suffix(".safetensors"), path.with_suffix(".initial.safetensors"))
    path.write_text(json.dumps(record | {"initial_policy_fingerprint": "0" * 12}))
    with pytest.raises(BundleError, match="is not the policy that the run began with"):
        published(load_agent(tmp_path / "mine"), "coop_nav-3", 2)
