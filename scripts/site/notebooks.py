"""Run notebooks, and turn them into pages.

`python scripts/site/notebooks.py` runs all of them and stores their outputs in them.
"""

from __future__ import annotations

import base64
import os
import re
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
_PICTURES = {"image/png": "png", "image/gif": "gif"}


def run(path: Path, folder: Path) -> nbformat.NotebookNode:
    """Run a notebook in a folder; its commands are those of this Python's environment.

    Raises:
        CellExecutionError: a cell failed.
    """
    notebook = nbformat.read(path, as_version=4)
    environment = {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"}
    client = NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    client.execute(env=environment)
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":
            cell.outputs = list(_merged(cell.outputs))
    return notebook


def _merged(outputs: list[nbformat.NotebookNode]) -> Iterator[nbformat.NotebookNode]:
    """Standard output in one piece and without colours; what goes to standard error is left out."""
    written = "".join(one.text for one in outputs if one.output_type == "stream" and one.name == "stdout")
    if written.strip():
        yield nbformat.v4.new_output(
            "stream", name="stdout", text=re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", written)
        )
    yield from (one for one in outputs if one.output_type != "stream")


def page(path: Path) -> tuple[str, dict[str, bytes]]:
    """A notebook as Markdown, and the pictures in it by the names that the page uses."""
    parts, pictures = [], dict[str, bytes]()
    for cell in nbformat.read(path, as_version=4).cells:
        if cell.cell_type == "markdown":
            parts.append(cell.source)
            continue
        language = "python"
        source = cell.source
        if source.startswith("%%bash\n"):
            language, source = "bash", source.removeprefix("%%bash\n")
        parts.append(f"```{language}\n{source}\n```")
        parts += [_output(output, path.stem, pictures) for output in cell.outputs]
    title, _, rest = parts[0].partition("\n")
    download = f"[Download this notebook]({path.name}), with the outputs as they are here."
    return "\n\n".join([title, rest.strip(), *parts[1:], download]) + "\n", pictures


def _output(output: nbformat.NotebookNode, stem: str, pictures: dict[str, bytes]) -> str:
    if output.output_type == "stream":
        return f'<div class="output" markdown>\n```text\n{output.text.strip()}\n```\n</div>'
    for kind, ending in _PICTURES.items():
        if kind in output.data:
            name = f"{stem}-{len(pictures)}.{ending}"
            pictures[name] = base64.b64decode(output.data[kind])
            return f"![output]({name})"
    if "text/html" in output.data:
        return f'<div class="output">{" ".join(output.data["text/html"].split())}</div>'
    return f'<div class="output" markdown>\n```text\n{output.data["text/plain"].strip()}\n```\n</div>'


if __name__ == "__main__":
    for notebook_path in sorted(FOLDER.glob("*.ipynb")):
        with tempfile.TemporaryDirectory() as workplace:
            nbformat.write(run(notebook_path, Path(workplace)), notebook_path)
        print(notebook_path)
