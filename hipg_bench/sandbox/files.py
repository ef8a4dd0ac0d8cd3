"""The files of a submission, and copies of them for the processes that run it."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from hipg_bench.errors import BundleError, HostFailure


def bundle_files(folder: Path) -> dict[str, Path]:
    """The files that belong to a bundle, by their path in it, in order; hidden ones and caches do not.

    Code of others runs in a copy that has these files only.

    Raises:
        BundleError: something is neither a file nor a folder, such as a link.
    """
    found: dict[str, Path] = {}
    for path in sorted(folder.rglob("*")):
        inside = path.relative_to(folder)
        if any(part.startswith(".") or part == "__pycache__" for part in inside.parts):
            continue
        if path.is_symlink() or not (path.is_file() or path.is_dir()):
            raise BundleError(f"{path}: links and devices are not allowed, only files and folders")
        if path.is_file():
            found[inside.as_posix()] = path
    return found


def private_copy(folder: Path) -> Path:
    """Copy a bundle's files into a new folder, which nobody but us can change.

    Raises:
        BundleError: as `bundle_files`.
        HostFailure: there is no room for it.
    """
    files = bundle_files(folder)
    place = Path(tempfile.mkdtemp(prefix="hipg-agent-"))
    try:
        for name, path in files.items():
            target = place / name
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(path, target)
        place.chmod(0o755)  # within the sandbox it belongs to nobody
    except OSError as error:
        shutil.rmtree(place, ignore_errors=True)
        raise HostFailure(f"the submission could not be copied to {place}: {error}") from error
    return place
