"""The zip in which a bundle travels: written the same every time, read without trusting anything in it.

Its ``manifest.json`` names every other file with its SHA-256. When one is read, everything that its directory
declares is checked before anything is unpacked, and what is unpacked is counted while it comes: nothing
appears under the target's name until all of it is right.
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

import pydantic

from hipg_bench.errors import BundleError, SpecError
from hipg_bench.paths import replacing
from hipg_bench.policies.bundle import bundle_files, digest
from hipg_bench.spec import Params, parse

MANIFEST = "manifest.json"
MOST_FILES = 1000
MOST_BYTES, MOST_BYTES_PER_FILE = 512_000_000, 100_000_000
"""Unpacked."""
ENDINGS = (".toml", ".md", ".txt", ".json", ".csv", ".safetensors", ".onnx", ".py", ".npy", ".npz")
"""Kinds of files that may be in a bundle; pickles (.pt, .pth, .pkl, .zip of others) may not."""
_ADVICE = "\n(make archives with `hipg-bench submit pack FOLDER`; those of other programs are refused)"
_MOST_DIRECTORY = 400_000
_MOST_MANIFEST = 400_000
_MOST_RATIO = 100
_LONGEST = 150
_PART = r"[A-Za-z0-9_][A-Za-z0-9_.+-]*"
_NAME = re.compile(rf"{_PART}(/{_PART}){{0,5}}")
_DAY = (1980, 1, 1, 0, 0, 0)
_END, _LARGE = b"PK\x05\x06", b"PK\x06\x07"
_CHUNK = 1 << 20


class Manifest(Params):
    """What an archive holds.

    Attributes:
        schema_version: 1.
        files: path to SHA-256.
    """

    schema_version: int = pydantic.Field(ge=1, le=1)
    files: dict[str, str] = pydantic.Field(max_length=MOST_FILES)


def check_name(name: str) -> None:
    """Refuse a path that a bundle may not have.

    Raises:
        BundleError: it leads elsewhere, is no plain name, or is of a kind that is not allowed.
    """
    if len(name) > _LONGEST or not _NAME.fullmatch(name) or ".." in name:
        raise BundleError(
            f"{name[:80]!r}: names of letters, digits and _ . + - are allowed, in folders at most 5 deep"
        )
    if PurePosixPath(name).suffix.lower() not in ENDINGS and PurePosixPath(name).name != "LICENSE":
        raise BundleError(
            f"{name!r}: only {' '.join(ENDINGS)} are allowed; write weights as .safetensors or .npz"
        )


def check_sizes(sizes: Mapping[str, int]) -> None:
    """Refuse too many or too large files.

    Raises:
        BundleError: they are.
    """
    if len(sizes) > MOST_FILES:
        raise BundleError(f"at most {MOST_FILES} files are allowed, got {len(sizes)}")
    for name, size in sizes.items():
        if size > MOST_BYTES_PER_FILE:
            raise BundleError(f"file {name!r}: at most {MOST_BYTES_PER_FILE} bytes are allowed, got {size}")
    if sum(sizes.values()) > MOST_BYTES:
        raise BundleError(f"at most {MOST_BYTES} bytes are allowed in all, got {sum(sizes.values())}")


def pack(folder: Path, archive: Path) -> str:
    """Write a bundle's folder as a zip, the same bytes for the same files.

    Returns:
        SHA-256 of the zip.

    Raises:
        BundleError: a file in the folder is not allowed.
    """
    files = {name: path for name, path in bundle_files(folder).items() if name != MANIFEST}
    for name in files:
        check_name(name)
    check_sizes({name: path.stat().st_size for name, path in files.items()})
    manifest = Manifest(schema_version=1, files={name: digest(path) for name, path in files.items()})
    with replacing(archive) as temporary:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_STORED) as writer:
            writer.writestr(_entry(MANIFEST), manifest.model_dump_json(indent=1))
            for name, path in files.items():
                with path.open("rb") as source, writer.open(_entry(name), "w") as target:
                    shutil.copyfileobj(source, target, _CHUNK)
        return digest(temporary)


def unpack(archive: Path, folder: Path) -> None:
    """Unpack a zip of `pack` into a new folder, all of it or nothing.

    Raises:
        BundleError: it is not such a zip, or its files are not what they are said to be.
        FileExistsError: the folder is there already.
    """
    if folder.exists():
        raise FileExistsError(f"{folder} is there already")
    folder.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".unpack-", dir=folder.parent) as temporary:
        whole = Path(temporary) / "bundle"
        whole.mkdir()
        try:
            _check_end(archive)
            with zipfile.ZipFile(archive) as reader:
                _unpack(reader, whole)
        except (BundleError, SpecError, zipfile.BadZipFile, NotImplementedError, zlib.error) as error:
            raise BundleError(f"{archive}: {error}{_ADVICE}") from error
        except (EOFError, UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
            raise BundleError(f"{archive}: cannot be read: {error}{_ADVICE}") from error
        whole.rename(folder)


def _entry(name: str) -> zipfile.ZipInfo:
    """An entry without a date, owner or rights of its own."""
    entry = zipfile.ZipInfo(name, _DAY)
    entry.external_attr = (stat.S_IFREG | 0o644) << 16
    entry.create_system = 3
    return entry


def _check_end(archive: Path) -> None:
    """Refuse a zip whose directory is too large to be read at all.

    The record at the end of the file says how long it is; one without a comment and of less than 4 GB, as
    `pack` writes it, is at a known place.
    """
    size = archive.stat().st_size
    if size > MOST_BYTES + _MOST_DIRECTORY:
        raise BundleError(f"at most {MOST_BYTES} bytes are allowed, got {size}")
    with archive.open("rb") as file:
        file.seek(max(0, size - 42))
        end = file.read()
    if len(end) < 22 or end[-22:-18] != _END or end[-2:] != b"\0\0" or end[:4] == _LARGE:
        raise BundleError("not a zip written by `hipg-bench submit pack`")
    count, directory = int.from_bytes(end[-12:-10], "little"), int.from_bytes(end[-10:-6], "little")
    if count > MOST_FILES + 1 or directory > _MOST_DIRECTORY:
        raise BundleError(f"at most {MOST_FILES} files are allowed, got {count}, listed in {directory} bytes")


def _unpack(reader: zipfile.ZipFile, folder: Path) -> None:
    """Check what is declared, then write the files into a folder of our own."""
    entries = _declared(reader)
    manifest = _manifest(reader, entries)
    for name, expected in manifest.files.items():
        target = folder / name
        target.parent.mkdir(parents=True, exist_ok=True)
        _write(reader, entries[name], target, expected)


def _declared(reader: zipfile.ZipFile) -> dict[str, zipfile.ZipInfo]:
    """The entries by name, each of a kind and size that is allowed."""
    entries: dict[str, zipfile.ZipInfo] = {}
    names: set[str] = set()  # in lower case: some file systems know no other
    for entry in reader.infolist():
        name = entry.filename
        check_name(entry.orig_filename)
        if name != entry.orig_filename or name.lower() in names:
            raise BundleError(f"file {name!r} is there twice, or has two names")
        kind = stat.S_IFMT(entry.external_attr >> 16)
        if kind not in (0, stat.S_IFREG) or entry.external_attr & 0x10 or entry.flag_bits & 0x1:
            raise BundleError(f"file {name!r}: links, folders, devices and encrypted files are not allowed")
        if entry.header_offset < 0:
            raise BundleError(f"file {name!r} begins before the archive does")
        if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
            raise BundleError(f"file {name!r}: only stored or deflated files are allowed")
        if entry.file_size > _MOST_RATIO * entry.compress_size + _CHUNK:
            raise BundleError(f"file {name!r}: {entry.file_size} bytes packed into {entry.compress_size}")
        entries[name] = entry
        names.add(name.lower())
    check_sizes({name: entry.file_size for name, entry in entries.items() if name != MANIFEST})
    for name in entries:
        if any(str(folder) in entries for folder in PurePosixPath(name).parents):
            raise BundleError(f"file {name!r} lies in a folder that is a file")
    return entries


def _manifest(reader: zipfile.ZipFile, entries: Mapping[str, zipfile.ZipInfo]) -> Manifest:
    """The manifest, which names just the files that are there."""
    if MANIFEST not in entries or entries[MANIFEST].file_size > _MOST_MANIFEST:
        raise BundleError(f"a {MANIFEST} of at most {_MOST_MANIFEST} bytes must be in it: pack it again")
    with reader.open(entries[MANIFEST]) as file:
        values = json.loads(file.read(_MOST_MANIFEST + 1))
    manifest = parse(Manifest, values if isinstance(values, dict) else {}, MANIFEST)
    different = set(manifest.files) ^ (set(entries) - {MANIFEST})
    if different:
        raise BundleError(f"{MANIFEST} and the files differ: {sorted(different)[:5]}")
    return manifest


def _write(reader: zipfile.ZipFile, entry: zipfile.ZipInfo, target: Path, expected: str) -> None:
    """Unpack one file, counting what comes."""
    seen, left = hashlib.sha256(), entry.file_size
    with reader.open(entry) as source, target.open("xb") as file:
        while chunk := source.read(_CHUNK):
            left -= len(chunk)
            if left < 0:
                break
            seen.update(chunk)
            file.write(chunk)
    if left != 0:
        raise BundleError(f"file {entry.filename!r} is not of the {entry.file_size} bytes it is said to be")
    if seen.hexdigest() != expected:
        raise BundleError(f"file {entry.filename!r} is not the one in {MANIFEST}: its SHA-256 differs")
