"""The notebooks run from top to bottom, and show what their text says."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
pytest.importorskip("nbclient", reason="the packages of the site are not installed: scripts/setup.sh --docs")
sys.path.insert(0, str(ROOT / "scripts" / "site"))

import notebooks  # noqa: E402

from hipg_bench.rendering import gl  # noqa: E402

needs_pictures = pytest.mark.skipif(gl.working_backend() is None, reason="no OpenGL here")


def written(notebook) -> str:
    """All that the cells printed."""
    outputs = [one for cell in notebook.cells if cell.cell_type == "code" for one in cell.outputs]
    return "".join(one.text for one in outputs if one.output_type == "stream")


def pictures(notebook) -> int:
    outputs = [one for cell in notebook.cells if cell.cell_type == "code" for one in cell.outputs]
    return sum(kind.startswith("image/") for one in outputs for kind in one.get("data", {}))


@needs_pictures
def test_an_agent_dies_and_then(tmp_path):
    path = notebooks.FOLDER / "an_agent_dies.ipynb"
    done = notebooks.run(path, tmp_path)
    said = written(done)
    assert "drone 2 dies after 1.1 s" in said
    assert "observes [0.]" in said
    assert "motors  [0. 0. 0.]" in said
    # the two worlds part: the team without the drone gets less
    assert "its life is worth 6.8" in said
    assert pictures(done) == 5
    import nbformat

    assert written(nbformat.read(path, as_version=4)) == said, "run scripts/site/notebooks.py again"


@needs_pictures
def test_train_evaluate_film_submit(tmp_path):
    done = notebooks.run(notebooks.FOLDER / "train_evaluate_film_submit.ipynb", tmp_path)
    said = written(done)
    assert "ready: hipg-bench submit pack first_try" in said
    assert (tmp_path / "first_try.zip").stat().st_size > 1000
    assert (tmp_path / "film.gif").read_bytes()[:3] == b"GIF"
    assert pictures(done) == 2
