"""`submit init`, `check` and `pack`: what is wrong with a folder is found, and said with a remedy."""

import json
import re
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.numpy import load_file, save_file
from torch import nn
from typer.testing import CliRunner

from hipg_bench import make, task_spec
from hipg_bench.cli import app
from hipg_bench.errors import BundleError, UnknownNameError
from hipg_bench.learning.run import train
from hipg_bench.learning.settings import recommended
from hipg_bench.policies.bundle import load_agent
from hipg_bench.policies.card import read_card
from hipg_bench.policies.export import export_sequential
from hipg_bench.submissions.archive import unpack
from hipg_bench.submissions.check import check
from hipg_bench.submissions.init import init
from hipg_bench.submissions.smoke import try_task

TASK = "hazard_nav-4"
CARD = {"authors": "Ada Lovelace", "license": "MIT", "summary": "A network that was never trained"}


def sizes(task):
    layout = make(task).layout
    return layout.observation.size, layout.action.size


def filled(folder, tier=0):
    """What `init` makes, filled in but for weights."""
    init(folder, tier, **CARD)
    (folder / "README.md").write_text("# An agent\n" + "It was trained on nothing, for no time at all. " * 8)
    return folder


def write_weights(path, size=None):
    torch.manual_seed(0)
    seen, done = size or sizes(TASK)
    export_sequential(nn.Sequential(nn.Linear(seen, 8), nn.Tanh(), nn.Linear(8, done)), path)
    return path


def coded(folder, act, head=""):
    """A tier-2 agent whose act is an expression of observation, alive, and self.size (A)."""
    filled(folder, 2)
    (folder / "agent.py").write_text(
        f"import time\nimport numpy as np\n{head}\n"
        "class Agent:\n"
        "    def __init__(self, task, train_seed): self.size = task['action_size']\n"
        "    def reset(self, seeds): pass\n"
        f"    def act(self, observation, alive): return {act}\n"
        "make_agent = Agent\n"
    )
    return folder


def change(path, old, new):
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    """A short training run of seed 3."""
    out = tmp_path_factory.mktemp("run") / "coop"
    settings = recommended("coop_nav-3", steps=200, num_envs=4, rollout=50, seed=3)
    train(settings, out, command="hipg-bench train --task coop_nav-3 ...")
    return out


def test_a_training_run_becomes_an_agent_that_passes(run_folder, tmp_path):
    folder = tmp_path / "mine"
    init(folder, 0, authors="Ada Lovelace", license="MIT", runs=[run_folder])
    assert [one.where for one in check(folder) if one.severity == "error"] == []
    agent = load_agent(folder)
    assert (agent.tasks, agent.train_seeds("coop_nav-3")) == (("coop_nav-3",), (3,))
    assert agent.card.training.env_steps == 200
    assert (folder / "coop_nav-3/seed3.safetensors").read_bytes() == (
        run_folder / "policy.safetensors"
    ).read_bytes()
    assert "hipg-bench train --task coop_nav-3 ..." in (folder / "README.md").read_text()


def test_runs_that_make_no_agent_are_refused_and_leave_nothing(run_folder, tmp_path):
    (tmp_path / "empty").mkdir()
    for tier, runs, message in (
        (1, [run_folder], "of tier 0, got tier 1"),
        (0, [run_folder, run_folder], "same task and seed"),
        (0, [tmp_path / "empty"], "train.json"),
        (0, [tmp_path / "none"], "no such file or folder"),
        (0, [run_folder / "policy.safetensors", "random"], "no folder of a training run"),
    ):
        with pytest.raises((BundleError, UnknownNameError), match=message):
            init(tmp_path / "mine", tier, runs=[Path(run) for run in runs])
        assert not (tmp_path / "mine").exists()


def test_the_next_steps_are_those_that_are_left(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    said = CliRunner().invoke(app, ["submit", "init", "fresh", "--license", "MIT"]).output
    steps = [line for line in said.splitlines() if line[0].isdigit()]
    assert len(steps) == 5
    assert "fill in authors, summary" in steps[1]
    # what the steps name is what `check` finds
    wrong = {finding.where for finding in check(tmp_path / "fresh") if finding.severity == "error"}
    assert wrong == {"agent.toml: authors", "agent.toml: summary", "README.md", "tasks"}


def test_a_filled_template_of_tier_0_passes_and_is_packed(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = CliRunner()
    made = run.invoke(
        app, ["submit", "init", "my_agent", "--authors", "A 'B' \"C\"", "--license", "MIT", "--summary", "s"]
    )
    assert made.exit_code == 0, made.output
    assert "1. write <task>/seed<k>.safetensors into my_agent" in made.output
    assert "fill in" not in made.output
    before = run.invoke(app, ["submit", "pack", "my_agent"])
    assert before.exit_code == 1
    assert "README.md: still says TODO" in before.output
    assert not (tmp_path / "my_agent.zip").exists()
    (tmp_path / "my_agent" / "README.md").write_text("# Mine\n" + "words " * 60)
    write_weights(tmp_path / "my_agent" / TASK / "seed3.safetensors")
    checked = run.invoke(app, ["submit", "check", "my_agent"])
    assert checked.exit_code == 0, checked.output
    assert "ready: hipg-bench submit pack my_agent" in checked.output
    assert "plays 1 of 7 tasks (trained seeds): hazard_nav-4 (1)" in checked.output
    packed = run.invoke(app, ["submit", "pack", "my_agent", "-o", "out/mine.zip"])
    assert packed.exit_code == 0, packed.output
    assert "sha256" in packed.output
    unpack(tmp_path / "out" / "mine.zip", tmp_path / "again")
    agent = load_agent(tmp_path / "again")
    assert agent.card.authors == "A 'B' \"C\""
    assert agent.train_seeds(TASK) == (3,)
    assert zipfile.ZipFile(tmp_path / "out" / "mine.zip").namelist()[0] == "manifest.json"


def test_the_template_of_tier_2_plays_the_weights_it_is_given(tmp_path):
    folder = filled(tmp_path / "mine", 2)
    O, A = sizes("coop_nav-3")  # noqa: E741, N806
    (folder / "coop_nav-3").mkdir()
    chance = np.random.default_rng(0)
    layers = {
        "weight0": chance.normal(size=(8, O)),
        "bias0": np.ones(8),
        "weight1": chance.normal(size=(A, 8)),
        "bias1": np.zeros(A),
    }
    np.savez(folder / "coop_nav-3" / "seed0.npz", **layers)
    findings = list(check(folder))
    assert not [finding for finding in findings if finding.severity == "error"], findings
    assert any("decentralised:" in finding.what for finding in findings)
    agent = load_agent(folder).policy(task_spec("coop_nav-3"))
    seen = chance.normal(size=(2, 3, O)).astype(np.float32)
    action, _ = agent.act(seen, agent.initial_state(0, np.arange(2), 3), np.ones((2, 3), bool))
    expected = np.tanh(seen @ layers["weight0"].T + 1) @ layers["weight1"].T
    np.testing.assert_allclose(action, expected.clip(-1, 1), atol=2e-5)


def nan(folder):
    path = write_weights(filled(folder) / TASK / "seed0.safetensors")
    metadata, tensors = safe_open(path, "numpy").metadata(), load_file(path)
    tensors["layer0.bias"][3] = np.nan
    save_file(tensors, path, metadata)


def unknown_task(folder):
    write_weights(filled(folder) / "hazard_nav4" / "seed0.safetensors")


def misnamed(folder):
    write_weights(filled(folder) / TASK / "model_07.safetensors")


def too_small(folder):
    write_weights(filled(folder) / TASK / "seed0.safetensors", (50, 3))


def of_torch(folder):
    (filled(folder) / TASK).mkdir()
    torch.save({}, folder / TASK / "seed0.pt")


def undeclared(folder):
    (filled(folder) / TASK).mkdir()
    save_file({"actor.0.weight": np.zeros((3, 51), np.float32)}, folder / TASK / "seed0.safetensors")


def misspelt(folder):
    change(filled(folder) / "agent.toml", "license =", "licence =")


def unsigned(folder):
    change(filled(folder) / "agent.toml", '"Ada Lovelace"', '""')


def unlicensed(folder):
    change(filled(folder) / "agent.toml", '"MIT"', '"do what you like"')
    write_weights(folder / TASK / "seed0.safetensors")


def without_readme(folder):
    (filled(folder) / "README.md").unlink()


def builtin(folder):
    folder.mkdir()
    (folder / "agent.toml").write_text('name = "x"\nsummary = "s"\nbuiltin = "scripted"')


def other_suite(folder):
    change(filled(folder) / "agent.toml", '"hipg-1"', '"hipg-9"')


def with_code(folder):
    write_weights(filled(folder) / TASK / "seed0.safetensors")
    (folder / "train.py").write_text("")


def bad_curve(folder):
    write_weights(filled(folder) / TASK / "seed0.safetensors")
    (folder / TASK / "seed0.curve.csv").write_text("step,return\n1,2\n")


def of_other_kind(folder):
    (filled(folder) / TASK).mkdir()
    (folder / TASK / "seed0.onnx").write_bytes(b"")


def missing_module(folder):
    (filled(folder, 2) / "agent.py").rename(folder / "main.py")


ZEROS = "np.zeros((*alive.shape, self.size))"

BROKEN = {
    nan: ("error", "hazard_nav-4, seed 0", "layer0.bias must be finite", "the training diverged"),
    unknown_task: ("error", "hazard_nav4/", "did you mean 'hazard_nav-4'?", "`hipg-bench tasks`"),
    misnamed: ("error", "hazard_nav-4/model_07.safetensors", "is not looked at", "-4/seed7.safetensors"),
    too_small: ("error", "hazard_nav-4, seed 0", "(O, A) = (51, 3), its network (50, 3)", "right folder?"),
    of_torch: ("error", "hazard_nav-4/seed0.pt", "write weights as .safetensors or", "convert"),
    undeclared: ("error", "hazard_nav-4, seed 0", "formats 'hipg-mlp-1'", "hipg_bench.policies.export"),
    misspelt: ("error", "agent.toml", "no field 'licence'; did you mean 'license'?", "docs/guides/submit.md"),
    unsigned: ("error", "agent.toml: authors", "is missing", 'authors = "Ada'),
    unlicensed: ("advice", "agent.toml: license", "is no SPDX identifier", "MIT, Apache-2.0"),
    without_readme: ("error", "README.md", "is missing", "how it was trained"),
    builtin: ("error", "agent.toml: builtin", "cannot be submitted", 'kind = "network"'),
    other_suite: ("error", "agent.toml: suite", "there is no suite 'hipg-9'", 'suite = "hipg-1"'),
    with_code: ("advice", "train.py", "is never run", "remove it"),
    bad_curve: ("error", "hazard_nav-4/seed0.curve.csv", "has no column steps", "steps (control steps)"),
    of_other_kind: ("error", "hazard_nav-4/seed0.onnx", "as the kind is 'network'", 'kind = "onnx"'),
    filled: ("error", "tasks", "it plays no task of the suite", "add such as coop_nav-3/seed0.safetensors"),
    missing_module: ("error", "agent.toml: entry_point", "there is no agent.py", "make_agent in my_agent.py"),
    lambda folder: coded(folder, ZEROS, "import torchh"): (
        "error", "coop_nav-3, seed 0", "'torchh'", "it can import",
    ),
    lambda folder: coded(folder, "np.zeros((len(alive), self.size))"): (
        "error", "coop_nav-3, seed 0", "actions have shape [1, 3, 3] (B, N, A), got shape [1, 3]", "(B, N",
    ),
    lambda folder: coded(folder, f"{ZEROS} / observation[..., 25:26]"): (
        "error", "coop_nav-3, seed 0", "the agent failed (not_finite)", "divisions",
    ),
    lambda folder: coded(folder, "open('/root/x')"): (
        "error", "coop_nav-3, seed 0", "FileNotFoundError", "Path(__file__)",
    ),
    lambda folder: coded(folder, "np.random.uniform(-1, 1, (*alive.shape, self.size))"): (
        "error", "coop_nav-3, seed 0", "its actions depend on chance", "seeded in reset(seeds)",
    ),
    lambda folder: coded(folder, f"{ZEROS} + np.tanh(observation.mean((1, 2)))[:, None, None]"): (
        "advice", "coop_nav-3", "the card says 'decentralised'", 'execution = "centralised"',
    ),
}  # fmt: skip
"""What is done to a folder, and the finding that tells: severity, where, part of what, part of the remedy."""


@pytest.mark.parametrize("spoil", BROKEN, ids=lambda spoil: BROKEN[spoil][2][:40])
def test_what_is_wrong_is_found_and_said_with_what_to_do(tmp_path, spoil):
    spoil(tmp_path / "mine")
    severity, where, what, remedy = BROKEN[spoil]
    found = [
        finding for finding in check(tmp_path / "mine") if finding.where == where and what in finding.what
    ]
    assert len(found) == 1
    assert found[0].severity == severity
    assert remedy in found[0].remedy


def test_what_cannot_be_a_bundle_is_said_so(tmp_path):
    (found,) = check(tmp_path / "nothing")
    assert "there is no such folder" in found.what
    filled(tmp_path / "outer" / "inner")
    (found,) = check(tmp_path / "outer")
    assert found.remedy == f"check {tmp_path / 'outer' / 'inner'} instead"
    (tmp_path / "outer" / "agent.toml").symlink_to("/etc/passwd")
    (found,) = check(tmp_path / "outer")
    assert found.severity == "error"


def test_an_agent_that_is_too_slow_is_told_how_slow(tmp_path):
    folder = coded(tmp_path / "mine", f"time.sleep(0.13 * len(alive)) or {ZEROS}")
    found = list(try_task(load_agent(folder), task_spec("coop_nav-3").override(horizon=3), 0))
    (slow,) = [finding for finding in found if finding.severity == "error"]
    # 130 ms and what a busy machine adds
    assert re.search(r"a step takes (1[3-9]|[2-9]\d)\d\.\d ms", slow.what)
    assert "of 100 ms" in slow.what
    assert "smaller network" in slow.remedy


def test_findings_for_scripts(tmp_path):
    folder = filled(tmp_path / "mine")
    done = CliRunner().invoke(app, ["submit", "check", str(folder), "--json"])
    assert done.exit_code == 1
    findings = json.loads(done.output)
    assert {finding["severity"] for finding in findings} == {"error", "advice", "fine"}
    assert set(findings[0]) == {"severity", "where", "what", "remedy"}


@pytest.mark.parametrize(
    ("name", "tier", "reason"),
    [("My Agent", 0, "did you mean 'my_agent'?"), ("x", 3, "tier 3: 0 "), ("there", 0, "is there already")],
)
def test_init_refuses(tmp_path, name, tier, reason):
    (tmp_path / "there").mkdir()
    with pytest.raises(BundleError, match=reason):
        init(tmp_path / name, tier)


def test_any_author_can_be_named(tmp_path):
    """JSON would escape what lies beyond the basic plane in a way that TOML does not know."""
    authors = 'Ada "L" \\ 😀 \x7f Ünal 中文'
    init(tmp_path / "agent_a", 0, authors=authors, license="MIT", summary="s")
    assert read_card(tmp_path / "agent_a" / "agent.toml").authors == authors


def test_a_byte_order_mark_gets_advice(tmp_path):
    init(tmp_path / "agent_a", 0)
    card = tmp_path / "agent_a" / "agent.toml"
    card.write_bytes(b"\xef\xbb\xbf" + card.read_bytes())
    with pytest.raises(BundleError, match="byte-order mark: save it as UTF-8 without one"):
        read_card(card)


def test_a_folder_packed_from_within_does_not_hold_its_archive(tmp_path, monkeypatch):
    folder = filled(tmp_path / "newcomer")
    write_weights(folder / TASK / "seed0.safetensors")
    monkeypatch.chdir(folder)
    for _ in range(2):
        done = CliRunner().invoke(app, ["submit", "pack", "."])
        assert done.exit_code == 0, done.output
    assert (tmp_path / "newcomer.zip").is_file()
    assert not list(folder.glob("*.zip"))


def test_an_archive_of_another_program_is_refused_with_advice(tmp_path):
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as made:
        made.writestr("newcomer/agent.toml", "x")
    with pytest.raises(BundleError, match="hipg-bench submit pack FOLDER"):
        unpack(tmp_path / "a.zip", tmp_path / "out")


def test_weights_that_are_no_numbers_are_not_written(tmp_path):
    layer = torch.nn.Linear(4, 2)
    with torch.no_grad():
        layer.weight[0, 0] = float("nan")
    with pytest.raises(BundleError, match="must be finite"):
        export_sequential(torch.nn.Sequential(layer), tmp_path / "a.safetensors")
    assert not list(tmp_path.iterdir())
