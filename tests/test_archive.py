"""Archives come out as they went in; hostile ones are refused and leave nothing behind."""

import hashlib
import json
import shutil
import stat
import tracemalloc
import zipfile
import zlib

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hipg_bench.errors import BundleError
from hipg_bench.policies.bundle import load_agent
from hipg_bench.submissions import archive
from hipg_bench.submissions.archive import MANIFEST, pack, unpack

CARD = 'name = "one"\nsummary = "s"\nkind = "network"\n'
FILES = {
    "agent.toml": CARD.encode(),
    "README.md": b"# one\n",
    "hazard_nav-4/seed0.safetensors": bytes(range(256)),
}


def folder_of(path, files):
    for name, content in files.items():
        (path / name).parent.mkdir(parents=True, exist_ok=True)
        (path / name).write_bytes(content)
    return path


def content_of(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()
    }


@pytest.fixture
def packed(tmp_path):
    pack(folder_of(tmp_path / "one", FILES), tmp_path / "one.zip")
    return tmp_path / "one.zip"


def test_what_was_packed_comes_out(packed, tmp_path):
    unpack(packed, tmp_path / "out" / "again")
    assert content_of(tmp_path / "out" / "again") == FILES
    assert load_agent(tmp_path / "out" / "again").tasks == ("hazard_nav-4",)
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["again"]
    assert zipfile.ZipFile(packed).testzip() is None  # others can read it


def test_the_same_folder_is_the_same_zip(packed, tmp_path):
    folder = folder_of(tmp_path / "two", dict(reversed(FILES.items())))
    (folder / "__pycache__").mkdir()
    (folder / "__pycache__" / "x.pyc").write_bytes(b"x")
    (folder / ".git").write_bytes(b"x")
    (folder / "agent.toml").touch(0o600)
    digest = pack(folder, tmp_path / "two.zip")
    assert (tmp_path / "two.zip").read_bytes() == packed.read_bytes()
    assert digest == hashlib.sha256(packed.read_bytes()).hexdigest()


def test_a_folder_that_is_there_stays(packed, tmp_path):
    with pytest.raises(FileExistsError):
        unpack(packed, tmp_path / "one")


@pytest.mark.parametrize(
    ("name", "reason"),
    [("weights.pt", "write weights as .safetensors"), ("run", "only .toml"), ("a b.md", "names of letters")],
)
def test_what_may_not_travel_is_not_packed(tmp_path, name, reason):
    with pytest.raises(BundleError, match=reason):
        pack(folder_of(tmp_path / "one", FILES | {name: b""}), tmp_path / "one.zip")
    assert not (tmp_path / "one.zip").exists()


def test_links_are_not_packed(tmp_path):
    folder = folder_of(tmp_path / "one", FILES)
    (folder / "notes.md").symlink_to("/etc/passwd")
    with pytest.raises(BundleError, match="links and devices are not allowed"):
        pack(folder, tmp_path / "one.zip")


def zipped(path, files, manifest=None, compress=zipfile.ZIP_STORED, **fields):
    """A zip made by hand: right but for what is given. ``fields`` are set on every entry but the manifest."""
    listed = {name: hashlib.sha256(content).hexdigest() for name, content in files}
    declared = {"schema_version": 1, "files": listed} if manifest is None else manifest
    with zipfile.ZipFile(path, "w", compress) as writer:
        writer.writestr(MANIFEST, declared if isinstance(declared, (str, bytes)) else json.dumps(declared))
        for name, content in files:
            entry = zipfile.ZipInfo(name)
            entry.compress_type = compress
            for field, value in fields.items():
                setattr(entry, field, value)
            writer.writestr(entry, content)
    return path


def refused(path, tmp_path):
    """The reason; and nothing is left of it."""
    before = {p for p in tmp_path.rglob("*")}
    with pytest.raises(BundleError) as caught:
        unpack(path, tmp_path / "out")
    assert {p for p in tmp_path.rglob("*")} == before
    return str(caught.value)


@pytest.mark.parametrize(
    "name",
    [
        "../agent.toml", "a/../../x.md", "/etc/x.md", "C:/x.md", "a\\..\\x.md", "./x.md", "a//x.md", "x.md/",
        ".ssh/x.md", "x\u202e.md", "a/b/c/d/e/f/g.md", "x" * 200 + ".md", "\n.md", "-rf.md", "~/x.md", "",
        "a/..md/x.md", "CON:.md",
    ],
)  # fmt: skip
def test_paths_that_lead_elsewhere_are_refused(tmp_path, name):
    assert "names of letters, digits" in refused(zipped(tmp_path / "x.zip", [(name, b"x")]), tmp_path)


def test_a_name_that_ends_early_is_refused(tmp_path):
    """The zip module cuts names at a zero byte; whoever reads on would see another name."""
    path = zipped(tmp_path / "x.zip", [("READMEx.md", b"x")])
    path.write_bytes(path.read_bytes().replace(b"READMEx.md", b"README\0.md"))
    assert "names of letters" in refused(path, tmp_path)


@pytest.mark.parametrize("kind", [stat.S_IFLNK, stat.S_IFDIR, stat.S_IFCHR, stat.S_IFIFO])
def test_links_and_devices_are_refused(tmp_path, kind):
    path = zipped(tmp_path / "x.zip", [("x.md", b"/etc/passwd")], external_attr=(kind | 0o777) << 16)
    assert "links, folders, devices" in refused(path, tmp_path)


@pytest.mark.parametrize("names", [("x.md", "x.md"), ("x.md", "X.md")])
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_names_given_twice_are_refused(tmp_path, names):
    path = zipped(tmp_path / "x.zip", [(name, b"x") for name in names])
    assert "is there twice" in refused(path, tmp_path)


def test_a_file_is_no_folder(tmp_path):
    path = zipped(tmp_path / "x.zip", [("x.md", b"x"), ("x.md/y.md", b"x")])
    assert "lies in a folder that is a file" in refused(path, tmp_path)


@pytest.mark.parametrize(
    "name", ["run.sh", "agent.pkl", "policy.pt", "inner.zip", "lib.so", "page.html", "Makefile"]
)
def test_unexpected_kinds_of_files_are_refused(tmp_path, name):
    assert "are allowed; write weights as" in refused(zipped(tmp_path / "x.zip", [(name, b"x")]), tmp_path)


@pytest.mark.parametrize("compress", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_unusual_packing_is_refused(tmp_path, compress):
    path = zipped(tmp_path / "x.zip", [("x.md", b"x")], compress=compress)
    assert "only stored or deflated" in refused(path, tmp_path)


def test_a_bomb_is_refused_before_it_is_unpacked(tmp_path):
    path = zipped(tmp_path / "x.zip", [("x.csv", bytes(90_000_000))], compress=zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 100_000
    tracemalloc.start()
    reason = refused(path, tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "90000000 bytes packed into" in reason
    assert peak < 2_000_000


def test_a_file_larger_than_it_says_is_refused(tmp_path):
    """The directory says 10 bytes; 40 MB come."""
    path = zipped(tmp_path / "x.zip", [("x.csv", bytes(40_000_000))], compress=zipfile.ZIP_DEFLATED)
    true, lie = (40_000_000).to_bytes(4, "little"), (10).to_bytes(4, "little")
    path.write_bytes(path.read_bytes().replace(true, lie))
    tracemalloc.start()
    reason = refused(path, tmp_path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert "Bad CRC" in reason or "not of the 10 bytes" in reason
    assert peak < 8_000_000


def test_a_file_shorter_than_it_says_is_refused(tmp_path):
    path = zipped(tmp_path / "x.zip", [("x.csv", b"12345")], compress=zipfile.ZIP_DEFLATED)
    content = path.read_bytes()
    at = content.rindex(b"x.csv") - 22  # sizes in the directory stand 22 bytes before the name
    assert content[at : at + 4] == (5).to_bytes(4, "little")
    path.write_bytes(content[:at] + (77).to_bytes(4, "little") + content[at + 4 :])
    reason = refused(path, tmp_path)
    assert "not of the 77 bytes" in reason or "Bad CRC" in reason


def test_too_many_or_too_large_files_are_refused(tmp_path, monkeypatch):
    assert "at most 1000 files" in refused(
        zipped(tmp_path / "x.zip", [(f"{k}.md", b"") for k in range(1002)]), tmp_path
    )
    monkeypatch.setattr(archive, "MOST_BYTES_PER_FILE", 10)
    assert "at most 10 bytes are allowed, got 11" in refused(
        zipped(tmp_path / "x.zip", [("x.md", bytes(11))]), tmp_path
    )
    monkeypatch.setattr(archive, "MOST_BYTES", 15)
    assert "at most 15 bytes are allowed in all, got 20" in refused(
        zipped(tmp_path / "x.zip", [("x.md", bytes(10)), ("y.md", bytes(10))]), tmp_path
    )


def test_a_huge_directory_is_refused_before_it_is_read(tmp_path):
    """Half a million entries of nothing: the zip module alone would take 300 MB for them."""
    end = b"PK\x05\x06" + bytes(4) + b"\x10\0\x10\0" + (23_000_000).to_bytes(4, "little") + bytes(4) + b"\0\0"
    path = tmp_path / "x.zip"
    path.write_bytes(bytes(23_000_000) + end)
    assert "listed in 23000000 bytes" in refused(path, tmp_path)
    locator = b"PK\x06\x07" + bytes(16)
    path.write_bytes(bytes(100) + locator + end[:12] + bytes(8) + end[-2:])
    assert "not a zip written by" in refused(path, tmp_path)
    path.write_bytes(bytes(100) + end[:-2] + b"\x01\0")
    assert "not a zip written by" in refused(path, tmp_path)


@pytest.mark.parametrize(
    ("manifest", "reason"),
    [
        ("", "cannot be read"),
        ("[]", "schema_version is required and missing"),
        ("[" * 100_000, "cannot be read"),
        (b"\xff\xfe", "cannot be read"),
        ({"schema_version": 1, "files": {}}, "manifest.json and the files differ: ['x.md']"),
        ({"schema_version": 1, "files": {"x.md": "0" * 64}}, "'x.md' is not the one in manifest.json"),
        ({"schema_version": 1, "files": {"x.md": "0", "../y.md": "0"}}, "differ: ['../y.md']"),
        ({"schema_version": 2, "files": {}}, "schema_version = 2 is refused"),
        ({"schema_version": 1, "files": {}, "__class__": 1}, "no field '__class__'"),
    ],
)
def test_a_manifest_must_name_the_files(tmp_path, manifest, reason):
    assert reason in refused(zipped(tmp_path / "x.zip", [("x.md", b"x")], manifest), tmp_path)


def test_what_is_no_zip_is_refused(tmp_path):
    for content in (b"", b"PK", b"PK\x05\x06" + bytes(18), bytes(10_000), b"\x1f\x8b" + bytes(100)):
        (tmp_path / "x.zip").write_bytes(content)
        refused(tmp_path / "x.zip", tmp_path)


@pytest.fixture(scope="module")
def original(tmp_path_factory):
    folder = tmp_path_factory.mktemp("original")
    pack(folder_of(folder / "one", FILES), folder / "one.zip")
    return (folder / "one.zip").read_bytes()


@given(data=st.data())
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_damaged_zip_is_refused_or_holds_what_it_held(original, tmp_path, data):
    """Bytes changed, cut or moved anywhere."""
    content = bytearray(original)
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(content) - 1))
        match data.draw(st.sampled_from(["set", "cut", "insert"])):
            case "set":
                content[at] = data.draw(st.integers(0, 255))
            case "cut":
                del content[at : at + data.draw(st.integers(1, 40))]
            case "insert":
                content[at:at] = data.draw(st.binary(min_size=1, max_size=30))
        if not content:
            content = bytearray(1)
    shutil.rmtree(tmp_path / "out", ignore_errors=True)
    (tmp_path / "x.zip").write_bytes(content)
    try:
        unpack(tmp_path / "x.zip", tmp_path / "out")
    except BundleError:
        assert not (tmp_path / "out").exists()
    else:
        assert content_of(tmp_path / "out") == FILES
    assert {path.name for path in tmp_path.iterdir()} <= {"x.zip", "out"}


@given(names=st.lists(st.text(max_size=30), min_size=1, max_size=4), contents=st.binary(max_size=100))
@settings(max_examples=100, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@pytest.mark.filterwarnings("ignore:Duplicate name")
def test_whatever_the_names_nothing_leaves_the_folder(tmp_path, names, contents):
    target = tmp_path / "deep" / "er"
    shutil.rmtree(tmp_path / "deep", ignore_errors=True)
    try:
        path = zipped(tmp_path / "x.zip", [(name, contents) for name in names])
    except (UnicodeEncodeError, ValueError):
        return  # no zip can hold such a name
    try:
        unpack(path, target)
    except BundleError:
        pass
    else:
        assert set(content_of(target)) == set(names)
    assert {p.name for p in tmp_path.iterdir()} <= {"x.zip", "deep"}
    assert {p.name for p in (tmp_path / "deep").iterdir()} <= {"er"}


def test_the_bombs_are_bombs():
    """The control: what is refused above would unpack."""
    assert len(zlib.compress(bytes(90_000_000))) < 100_000
