"""Commands that write one file leave those of the user's alone, and write over their own."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hipg_bench.cli import app, outputs
from hipg_bench.comparison.figures import figure_names
from hipg_bench.errors import BundleError, HipgError
from hipg_bench.submissions.archive import pack
from hipg_bench.submissions.init import init

MARKS = (outputs.ARCHIVE, outputs.MARL_EVAL, outputs.PICTURE, outputs.VERDICTS)


def command(out: Path) -> dict[str, list[str]]:
    """Of each command, a line whose refusal must come before any work, so that its input need not exist."""
    return {
        "pack": ["submit", "pack", str(out.parent / "none"), "-o", str(out)],
        "export": ["export", str(out.parent / "none"), "--out", str(out)],
        "bench": ["bench", "--plot", str(out)],
    }


@pytest.mark.parametrize("mark", MARKS)
def test_files_links_and_folders_of_others_are_refused(tmp_path, mark):
    theirs, link, dangling, ours = (tmp_path / name for name in ("theirs", "link", "dangling", "ours"))
    theirs.write_text("mine")
    ours.write_bytes(b"PK" + mark + b" and so on")
    link.symlink_to(ours)
    dangling.symlink_to(tmp_path / "nowhere")
    for path in (theirs, link, dangling, tmp_path):
        with pytest.raises(HipgError, match="not overwritten"):
            outputs.check_free(path, mark)
    outputs.check_free(ours, mark)
    outputs.check_free(tmp_path / "new", mark)


@pytest.mark.parametrize("name", ["pack", "export", "bench"])
@pytest.mark.parametrize("linked", [False, True])
def test_commands_refuse_before_they_work(tmp_path, name, linked):
    out, thesis = tmp_path / "out.png", tmp_path / "thesis"
    thesis.write_text("mine")
    if linked:
        out.symlink_to(thesis)
    else:
        out.write_text("mine")
    done = CliRunner().invoke(app, command(out)[name])
    assert isinstance(done.exception, HipgError)
    assert "not overwritten" in str(done.exception)
    assert (out.read_text(), thesis.read_text(), out.is_symlink()) == ("mine", "mine", linked)


def test_an_archive_is_packed_again_over_an_earlier_one(tmp_path):
    folder, archive = tmp_path / "agent", tmp_path / "agent.zip"
    folder.mkdir()
    (folder / "README.md").write_text("one")
    pack(folder, archive)
    outputs.check_free(archive, outputs.ARCHIVE)


def test_figures_beside_ones_of_others(tmp_path):
    agents = Path(__file__).parent.parent / "agents"
    theirs = tmp_path / figure_names()[0]
    theirs.write_text("mine")
    options = ["figures", "--agents", str(agents), "--out", str(tmp_path)]
    done = CliRunner().invoke(app, options)
    assert isinstance(done.exception, HipgError)
    assert [path.name for path in tmp_path.iterdir()] == [theirs.name]
    assert theirs.read_text() == "mine"
    # with verdicts of ours beside them they are those of an earlier run
    (tmp_path / "verdicts.json").write_text(json.dumps([{"claim": "x", "p_improvement": None}]))
    assert outputs.is_ours(tmp_path / "verdicts.json", outputs.VERDICTS)


def test_init_follows_no_link(tmp_path):
    (tmp_path / "agent").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(BundleError, match="there already"):
        init(tmp_path / "agent", 0)
    assert not (tmp_path / "elsewhere").exists()
