"""Files of a user's survive whatever is started beside or on top of them."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from hipg_bench.claims import CLAIM
from hipg_bench.errors import ResumeError
from hipg_bench.evaluation import runner
from hipg_bench.evaluation.episodes import EvaluationJob
from hipg_bench.learning import checkpoint
from hipg_bench.learning.run import train
from hipg_bench.learning.settings import recommended
from hipg_bench.paths import PARTIAL, check_seal, new_folder, output_folder, write_text
from hipg_bench.policies.bundle import load_agent
from hipg_bench.registry import task_spec

SPEC = task_spec("hazard_nav-4").override(horizon=5)
SUITE = runner.Suite("custom", (SPEC,))
TINY = {"num_envs": 2, "rollout": 8, "steps": 16}


def evaluate(out, episodes=3):
    return runner.evaluate(load_agent("zero"), SUITE, out, EvaluationJob(episodes=episodes, threads=1))


def everything(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def project(tmp_path):
    """A folder of somebody's with all the names that once looked like left-overs."""
    folder = tmp_path / "project"
    for name in (
        ".env-2024.local", ".notes-1.md", "src/.secrets-01.json", "src/main.py", ".lock",
        "episodes/.draft-9.tex", "replay/mine.npy", ".draft-1/text", ".ready-2/text",
    ):  # fmt: skip
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(f"precious {name}")
    return folder


def test_an_evaluation_among_other_files_leaves_them_alone(project):
    before = everything(project)
    evaluate(project)
    evaluate(project)
    after = everything(project)
    assert {name: after.get(name) for name in before} == before
    assert (project / "results.json").exists()


@pytest.mark.parametrize("theirs", ["results.json", "report.html", "films/mine.npz", "videos/holiday.mp4"])
def test_an_evaluation_overwrites_no_file_of_others(project, theirs):
    path = project / theirs
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")
    before = everything(project)
    with pytest.raises(ResumeError, match=r"holds .* but no run\.json"):
        evaluate(project)
    assert everything(project) == before


def test_a_refused_folder_is_as_it_was(project):
    (project / "run.json").write_text('{"agent": "somebody_else"}')
    before = everything(project)
    with pytest.raises(ResumeError, match="belongs to another evaluation"):
        evaluate(project)
    assert everything(project) == before


@pytest.mark.parametrize("theirs", ["curve.csv", "replay/mine.npy", "checkpoint.pt"])
def test_a_training_overwrites_no_file_of_others(tmp_path, theirs):
    path = tmp_path / "own" / theirs
    path.parent.mkdir(parents=True)
    path.write_text("mine")
    with pytest.raises(ResumeError, match=r"holds .* but no train\.json"):
        train(recommended("hazard_nav-4", **TINY), tmp_path / "own", command="test")
    assert everything(tmp_path / "own") == {theirs: b"mine"}


@pytest.mark.parametrize("record", ["{}", '{"task": "hazard_nav-4"}', None])
def test_a_training_does_not_believe_a_record_of_others(tmp_path, record):
    """Nor one of another run, beside which somebody keeps files of the same names."""
    out = tmp_path / "own"
    if record is None:
        train(recommended("hazard_nav-4", **TINY, seed=7), out, command="test")
        (out / "checkpoint.pt").unlink()
        (out / "curve.csv").unlink()
    else:
        write_text(out / "train.json", record)
    (out / "policy.safetensors").write_text("mine")
    (out / "replay").mkdir(exist_ok=True)
    (out / "replay" / "mine.npy").write_text("mine")
    before = everything(out)
    with pytest.raises(ResumeError, match="choose another --out"):
        train(recommended("hazard_nav-4", **TINY), out, command="test")
    kept = {name for name in before if not name.startswith(CLAIM)}  # a claim says who works there now
    assert {name: everything(out).get(name) for name in kept} == {name: before[name] for name in kept}


def test_half_written_files_of_the_dead_are_removed(tmp_path):
    evaluate(tmp_path)
    for folder in (tmp_path, tmp_path / "episodes"):
        (folder / f"{PARTIAL}abc").mkdir()
        (folder / f"{PARTIAL}abc" / "new.json").write_text("half")
    evaluate(tmp_path)
    assert not list(tmp_path.rglob(f"{PARTIAL}*"))


def test_two_evaluations_into_one_folder(tmp_path):
    """The second is refused at once, and takes nothing from the first."""
    started, done = threading.Event(), threading.Event()

    def hold():
        with output_folder(tmp_path, "run.json", (), "evaluating"):
            started.set()
            done.wait(20)

    first = threading.Thread(target=hold)
    first.start()
    started.wait(20)
    with pytest.raises(ResumeError, match="another process is evaluating here"):
        evaluate(tmp_path)
    done.set()
    first.join()
    evaluate(tmp_path)


def test_folders_made_in_the_same_second_are_different(tmp_path):
    names = [new_folder(tmp_path / "runs", "zero-20261126-120000").name for _ in range(3)]
    assert names == ["zero-20261126-120000", "zero-20261126-120000-2", "zero-20261126-120000-3"]


@pytest.mark.parametrize(
    "damage",
    [
        lambda text: text[: len(text) // 2],
        lambda text: "",
        lambda text: "\0\1",
        lambda text: text.replace('"survival": 1.0', '"survival": 0.5', 1),
        lambda text: text.splitlines()[0] + "\n" + text,
        lambda text: "[1]\n",
        lambda text: "[" * 100_000,
    ],
)
@pytest.mark.parametrize("sealed", [True, False])
def test_damaged_rows_are_noticed_and_kept(tmp_path, damage, sealed):
    evaluate(tmp_path)
    path = tmp_path / "episodes" / "hazard_nav-4.jsonl"
    if not sealed:
        path.with_name(f".{path.name}.sha256").unlink()
    text = damage(path.read_text())
    path.write_text(text)
    if (not sealed and text in ("",)) or (not sealed and "0.5" in text):
        pytest.skip("without its checksum a file that holds rows is believed")
    with pytest.raises(ResumeError, match=r"hazard_nav-4\.jsonl"):
        evaluate(tmp_path)
    assert path.read_text() == text


@pytest.mark.parametrize("text", ["{", "[]", "", "[" * 100_000])
def test_a_damaged_record_is_told(tmp_path, text):
    evaluate(tmp_path)
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(ResumeError, match=r"run\.json is damaged"):
        evaluate(tmp_path)


@pytest.mark.parametrize("place", [100, 5000, -100])
def test_a_flipped_byte_of_a_checkpoint_is_noticed(tmp_path, place):
    settings = recommended("hazard_nav-4", **TINY)
    train(settings, tmp_path, command="test")
    path = tmp_path / "checkpoint.pt"
    content = bytearray(path.read_bytes())
    content[place] ^= 255
    path.write_bytes(content)
    with pytest.raises(ResumeError, match=r"checkpoint\.pt is damaged or was changed"):
        checkpoint.load(path)


@pytest.mark.parametrize("content", [b"", b"PK", b"\x80\x02}q\x00."])
def test_what_is_no_checkpoint_is_told(tmp_path, content):
    (tmp_path / "checkpoint.pt").write_bytes(content)
    with pytest.raises(ResumeError, match=r"checkpoint\.pt is (damaged|no checkpoint)"):
        checkpoint.load(tmp_path / "checkpoint.pt")


@pytest.mark.parametrize("damage", [None, "", 'x,y\n"', "iteration,steps\n1,2\n"])
def test_a_damaged_curve_is_told(tmp_path, damage):
    train(recommended("hazard_nav-4", **TINY), tmp_path, command="test")
    curve = tmp_path / "curve.csv"
    (tmp_path / ".curve.csv.sha256").unlink()
    curve.unlink() if damage is None else curve.write_text(damage)
    with pytest.raises(ResumeError, match=r"curve\.csv is missing or damaged"):
        train(recommended("hazard_nav-4", **{**TINY, "steps": 32}), tmp_path, command="test")


def test_a_checksum_is_of_the_old_or_the_new_file(tmp_path):
    """A kill between writing the checksum and the file leaves the old file, which is believed too."""
    path = tmp_path / "rows"
    write_text(path, "old", sealed=True)
    write_text(path, "new", sealed=True)
    check_seal(path)
    path.write_text("old")
    check_seal(path)
    path.write_text("other")
    with pytest.raises(ResumeError):
        check_seal(path)


def test_a_killed_write_leaves_the_file_whole(tmp_path):
    path = tmp_path / "file.json"
    write_text(path, "whole")
    script = (
        "import os, sys\nfrom pathlib import Path\nfrom hipg_bench.paths import replacing\n"
        "with replacing(Path(sys.argv[1])) as temporary:\n"
        "    temporary.write_text('half')\n    os.kill(os.getpid(), 9)\n"
    )
    done = subprocess.run([sys.executable, "-c", script, str(path)], timeout=60)
    assert done.returncode == -9
    assert path.read_text() == "whole"
    assert [one.name[: len(PARTIAL)] for one in tmp_path.iterdir() if one != path] == [PARTIAL]
    mask = os.umask(0)
    os.umask(mask)
    assert path.stat().st_mode & 0o777 == 0o666 & ~mask
