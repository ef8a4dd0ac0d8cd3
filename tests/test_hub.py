"""`hub push` and `hub pull`, against a fake of the Hub's HTTP API on loopback (`fake_hub`)."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
import yaml
from fake_hub import serving
from torch import nn
from typer.testing import CliRunner

from hipg_bench import make
from hipg_bench.cli import app
from hipg_bench.errors import BundleError, HipgError
from hipg_bench.evaluation import runner
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.policies.bundle import bundle_files, load_agent
from hipg_bench.policies.export import export_sequential
from hipg_bench.registry import task_spec
from hipg_bench.submissions import hub
from hipg_bench.submissions.init import init

pytest.importorskip("huggingface_hub")
TASK, REPO = "coop_nav-3", "ada/my_agent"


def bundle(folder, seed=0):
    init(folder, 0, authors="Ada Lovelace", license="MIT", summary="A network that was never trained")
    (folder / "README.md").write_text("# My agent\n\nIt was trained on nothing, for no time at all.\n")
    torch.manual_seed(seed)
    layout = make(TASK, compiled=False).layout
    network = nn.Sequential(nn.Linear(layout.observation.size, 4), nn.Tanh(), nn.Linear(4, 3))
    export_sequential(network, folder / TASK / "seed0.safetensors")
    return folder


@pytest.fixture(scope="module")
def desk(tmp_path_factory):
    """A bundle, and an evaluation of it with a video of 4 bytes."""
    desk = tmp_path_factory.mktemp("desk")
    agent = load_agent(bundle(desk / "my_agent"))
    job = EvaluationJob(episodes=2)
    results = runner.evaluate(agent, runner.Suite("custom", (task_spec(TASK),)), desk / "scores", job)
    (desk / "scores" / "videos").mkdir()
    (desk / "scores" / "videos" / "a.mp4").write_bytes(b"film")
    results["films"] = [{"task": TASK, "file": "videos/a.mp4", "title": "a"}]
    (desk / "scores" / "results.json").write_text(json.dumps(results))
    return desk


@pytest.fixture
def online(monkeypatch, tmp_path):
    """A fake hub, which this process takes for the Hub; the working folder is a new one."""
    from huggingface_hub import constants

    monkeypatch.setenv("HF_TOKEN", "hf_of_nobody")
    monkeypatch.setattr(constants, "HF_HUB_DISABLE_XET", True)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    with serving() as fake:
        monkeypatch.setattr(constants, "ENDPOINT", fake.address)
        template = fake.address + "/{repo_id}/resolve/{revision}/{filename}"
        monkeypatch.setattr(constants, "HUGGINGFACE_CO_URL_TEMPLATE", template)
        yield fake


def contents(folder):
    return {name: path.read_bytes() for name, path in bundle_files(folder).items()}


def run(*arguments, code=0, answer=""):
    done = CliRunner().invoke(app, [str(one) for one in arguments], input=answer)
    assert done.exit_code == code, (done.output, done.exception)
    return done.output


def test_an_agent_goes_to_the_hub_and_comes_back_by_the_command_line(desk, tmp_path):
    with serving() as fake:
        known = {
            "HF_ENDPOINT": fake.address, "HF_TOKEN": "hf_of_nobody", "HF_HUB_DISABLE_XET": "1",
            "HF_HOME": str(tmp_path / "cache"), "COLUMNS": "200",
        }  # fmt: skip

        def command(*arguments):
            return subprocess.run(
                [sys.executable, "-P", "-m", "hipg_bench", "hub", *arguments], cwd=tmp_path,
                env=os.environ | known, capture_output=True, text=True, check=False, timeout=120,
                stdin=subprocess.DEVNULL,
            )  # fmt: skip

        scores = ("--evaluation", str(desk / "scores"))
        refused = command("push", str(desk / "my_agent"), REPO, *scores)
        assert refused.returncode == 2
        assert "nothing is uploaded without being asked for: give --yes" in refused.stderr
        assert fake.requests == []
        pushed = command("push", str(desk / "my_agent"), REPO, *scores, "--yes", "--private")
        assert pushed.returncode == 0, pushed.stderr
        assert f"{fake.address}/{REPO}/commit/{fake.sha(REPO, 1)}" in pushed.stdout
        assert fake.private == {REPO}
        there = fake.repos[REPO][-1]
        ours = contents(desk / "my_agent")
        assert set(there) == {*ours, "config.json", "results.json", "replay.mp4"}
        weights = f"{TASK}/seed0.safetensors"
        assert {weights: there[weights], "agent.toml": there["agent.toml"]} == {
            name: ours[name] for name in (weights, "agent.toml")
        }
        assert there["replay.mp4"] == b"film"
        check_card(there["README.md"].decode(), json.loads((desk / "scores" / "results.json").read_text()))

        pulled = command("pull", REPO)
        assert pulled.returncode == 0, pulled.stderr
        assert f"my_agent: {REPO} at commit {fake.sha(REPO, 1)}" in pulled.stdout
        found = contents(tmp_path / "my_agent")
        assert set(found) == set(there) - {"replay.mp4"}
        assert found[weights] == ours[weights]
        assert found["README.md"].startswith(b"# My agent")
        assert sorted(path.name for path in tmp_path.iterdir()) == ["my_agent"]
        again = command("pull", REPO)
        assert again.returncode == 2
        assert "my_agent is there already" in again.stderr


def check_card(text, results):
    """What the Hub reads of a model card, by the format of its documentation."""
    _, front, body = text.split("---\n", 2)
    card = yaml.safe_load(front)
    (entry,) = card["model-index"]
    (result,) = entry["results"]
    (played,) = results["tasks"]
    assert (card["license"], card["library_name"], entry["name"]) == ("mit", "hipg-bench", "my_agent")
    assert result["dataset"] == {"name": f"{TASK} v1", "type": TASK, "split": "standard"}
    measured = {one["type"]: one["value"] for one in result["metrics"]}
    expected = {"mean_reward": played["return_mean"], "score": played["score"]}
    assert measured == {name: pytest.approx(value, abs=1e-4) for name, value in expected.items()}
    assert body.count("# My agent") == 1
    assert f"| {TASK} | 1 | {played['score']:.2f}" in body


def test_a_dry_run_writes_what_would_be_uploaded_and_asks_nobody(desk, online):
    said = run(
        "hub",
        "push",
        desk / "my_agent",
        REPO,
        "--evaluation",
        desk / "scores",
        "--dry-run",
        "--out",
        "staged",
    )
    assert "nothing was uploaded" in said
    assert set(contents(Path("staged"))) == {
        "README.md", "agent.toml", "config.json", "results.json", "replay.mp4", f"{TASK}/seed0.safetensors"
    }  # fmt: skip
    assert online.requests == []
    run("hub", "push", desk / "my_agent", REPO, "--dry-run")
    assert "model-index" not in Path("runs/hub-my_agent/README.md").read_text()


def test_a_prompt_that_is_not_answered_with_yes_uploads_nothing(desk, online, monkeypatch):
    from hipg_bench.cli import hub as cli_hub

    monkeypatch.setattr(cli_hub, "_is_interactive", lambda: True)
    assert "Upload these files" in run("hub", "push", desk / "my_agent", REPO, code=1, answer="n\n")
    assert online.requests == []
    run("hub", "push", desk / "my_agent", REPO, answer="y\n")
    assert list(online.repos) == [REPO]


def test_a_second_push_leaves_nothing_of_the_first(desk, online, tmp_path):
    (desk / "my_agent" / "old.txt").write_text("old")
    run("hub", "push", desk / "my_agent", REPO, "--yes")
    (desk / "my_agent" / "old.txt").unlink()
    run("hub", "push", desk / "my_agent", REPO, "--yes", "--evaluation", desk / "scores")
    assert ["old.txt" in files for files in online.repos[REPO]] == [False, True, False]
    # what was pulled can be pushed again, and its card does not grow
    first, _ = hub.pull(REPO, tmp_path / "my_agent")
    hub.stage(first, tmp_path / "staged", REPO, evaluation=desk / "scores", video=None)
    assert (tmp_path / "staged" / "README.md").read_bytes() == online.repos[REPO][-1]["README.md"]


def test_scores_of_other_policies_are_refused(desk, tmp_path):
    other = bundle(tmp_path / "my_agent", seed=1)
    with pytest.raises(BundleError, match=f"is of other policies than .* holds for {TASK}"):
        hub.stage(other, tmp_path / "staged", REPO, evaluation=desk / "scores", video=None)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["my_agent"]


def test_a_bundle_with_errors_is_not_pushed(online, tmp_path):
    init(tmp_path / "empty", 0)
    with pytest.raises(BundleError, match=r"has \d errors:\n  agent.toml: authors: is to be filled in"):
        hub.stage(tmp_path / "empty", tmp_path / "staged", REPO, evaluation=None, video=None)
    assert online.requests == []


HOSTILE = {
    "a path that leads elsewhere": ({"../../evil.py": b"x"}, "names of letters"),
    "a pickle": ({f"{TASK}/seed0.pt": b"x"}, "write weights as .safetensors"),
    "a hidden file": ({".git/config": b"x"}, "names of letters"),
    "two names in one": ({"Agent.toml": b"x"}, "but for upper and lower case"),
    "weights that are none": ({f"{TASK}/seed0.safetensors": b"not tensors"}, rf"{TASK}: {TASK}/seed0"),
    "a card that is none": ({"agent.toml": b"name = ["}, "has 1 error"),
    "a policy of the package": (
        {"agent.toml": b'name="x"\nsummary="y"\nbuiltin="zero"'},
        "cannot",
    ),
    "too many files": ({f"f{k}.txt": b"" for k in range(1001)}, "at most 1000 files"),
}


@pytest.mark.parametrize("what", HOSTILE)
def test_what_is_pulled_is_checked_before_it_is_put_in_place(desk, online, what):
    files, says = HOSTILE[what]
    online.put("eve/agent", contents(desk / "my_agent") | files)
    with pytest.raises(BundleError, match=says):
        hub.pull("eve/agent", None)
    assert list(Path().iterdir()) == []
    if "path" in what or "pickle" in what:  # refused by their names: nothing was downloaded
        assert not any("/resolve/" in path for _, path in online.requests)


def test_what_is_not_there_is_said_in_a_line(desk, online):
    with pytest.raises(HipgError, match="nobody/nothing: there is no such repository, or it is not yours"):
        hub.pull("nobody/nothing", None)
    online.put("ada/empty", {"README.md": b"x"})
    with pytest.raises(BundleError, match=r"the repository holds no agent\.toml"):
        hub.pull("ada/empty", None)
    with pytest.raises(HipgError, match="ada/empty: "):
        hub.pull("ada/empty", None, revision="f" * 40)
    with pytest.raises(HipgError, match=r"Repo id must"):
        hub.pull("one/two/three", None)
    online.put(REPO, contents(desk / "my_agent"))
    Path("taken").mkdir()
    with pytest.raises(HipgError, match="taken is there already"):
        hub.pull(REPO, Path("taken"))
    folder, commit = hub.pull(REPO, Path("new"), revision=online.sha(REPO, 1))
    assert (folder, commit) == (Path("new"), online.sha(REPO, 1))


def test_without_a_network_the_error_is_one_line(desk, online, monkeypatch):
    from huggingface_hub import constants

    monkeypatch.setattr(constants, "ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(HipgError, match=r"^ada/my_agent: [^\n]+$"):
        hub.pull(REPO, None)
