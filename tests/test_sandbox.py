"""Sandboxes refuse what they must, whoever tries; the child process obeys its parent."""

import os
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
from foreign import WORKING, descendants

from hipg_bench.errors import AgentFailure, HostFailure, SandboxError
from hipg_bench.evaluation import doctor
from hipg_bench.sandbox import bubblewrap, choice, landlock, probe
from hipg_bench.sandbox.backend import Start, open_door
from hipg_bench.sandbox.budget import Budget
from hipg_bench.sandbox.inside.probe_runner import ATTEMPTS
from hipg_bench.sandbox.process import Child

_SETUP = {
    "runner": "python_runner",
    "options": {"entry_point": "agent:make_agent"},
    "task": {},
    "train_seed": 0,
}
each_sandbox = pytest.mark.parametrize("name", WORKING)

# what the attempts of Python's own library come to, told in one line each; none may begin with "ok"
ATTACKS = """
    import array, ctypes, fcntl, mmap, os, resource, signal, socket, subprocess, sys, threading, time

    parent, secret, beside = {parent}, {secret!r}, {beside!r}

    def try_(name, attack):
        try:
            print(name, "ok", attack())
        except BaseException as error:
            print(name, type(error).__name__)

    def make_agent(task, train_seed):
        try_("secret", lambda: open(secret).read())
        try_("link", lambda: (os.symlink(secret, "/tmp/link"), open("/tmp/link").read()))
        try_("folder", lambda: os.listdir(os.path.dirname(secret)))
        try_("passwords", lambda: open("/etc/shadow").read())
        try_("home", lambda: os.listdir("/root"[:5] + "/.ssh"))
        try_("own environ", lambda: open("/proc/self/environ").read())
        try_("parent's environ", lambda: open(f"/proc/{{parent}}/environ").read())
        try_("parent's memory", lambda: open(f"/proc/{{parent}}/mem", "rb"))
        try_("beside", lambda: open(beside, "w"))
        try_("package", lambda: open(__file__, "a"))
        try_("library", lambda: open(os.__file__, "a"))
        try_("delete", lambda: os.remove(secret))
        try_("mode", lambda: os.chmod(secret, 0))
        try_("times", lambda: os.utime(secret, (0, 0)))
        try_("mode of own", lambda: os.chmod(__file__, 0o777))
        try_("owner", lambda: os.chown(secret, 1, 1))
        try_("attribute", lambda: os.setxattr(secret, "user.x", b"x"))
        try_("root", lambda: open("/x", "w"))
        try_("TCP", lambda: socket.socket())
        try_("UDP", lambda: socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
        try_("unix", lambda: socket.socket(socket.AF_UNIX))
        try_("netlink", lambda: socket.socket(socket.AF_NETLINK))
        try_("fork", lambda: os.fork() or os._exit(0))
        try_("thread", lambda: threading.Thread(target=time.sleep, args=(0,)).start())
        try_("program", lambda: os.execv(sys.executable, [sys.executable]))
        try_("shell", lambda: subprocess.run("true", shell=True, check=True))
        try_("kill", lambda: os.kill(parent, 0))
        try_("kill all", lambda: os.kill(-1, 0))
        try_("kill group", lambda: os.killpg(os.getpgid(parent), 0))
        try_("descriptor", lambda: os.pidfd_open(parent))
        try_("limits", lambda: resource.prlimit(parent, resource.RLIMIT_CPU, (1, 1)))
        try_("more memory", lambda: resource.setrlimit(resource.RLIMIT_AS, (-1, -1)))
        try_("more files", lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (9999, 9999)))
        try_("priority", lambda: os.setpriority(os.PRIO_PROCESS, parent, 19))
        try_("core", lambda: os.sched_setaffinity(parent, {{0}}))
        try_("memory file", lambda: os.memfd_create("x"))
        try_("4 GB", lambda: bytearray(4 << 30))
        try_("4 GB shared", lambda: mmap.mmap(-1, 4 << 30))
        try_("become root", lambda: os.setuid(1))
        try_("chroot", lambda: os.chroot("/"))
        libc = ctypes.CDLL(None, use_errno=True)
        def call(name, *arguments):
            if getattr(libc, name)(*arguments) < 0:
                raise OSError(ctypes.get_errno(), "")
        new_user, new_mount = 0x10000000, 0x20000
        try_("namespace", lambda: call("unshare", new_user | new_mount))
        try_("ptrace", lambda: call("ptrace", 16, parent, 0, 0))
        try_("mount", lambda: call("mount", b"x", b"/tmp", b"tmpfs", 0, None))
        try_("shared memory", lambda: call("shmget", 0, 4096, 0o1600))
        try_("host name", lambda: call("sethostname", b"x", 1))
        try_("clock", lambda: call("settimeofday", (ctypes.c_long * 2)(1, 1), None))
        try_("device", lambda: os.mknod("/tmp/device", 0o60600, os.makedev(8, 0)))
        def fill():
            for k in range(99):
                with open(f"/tmp/{{k}}", "wb") as file:
                    file.write(bytes(8 << 20))
        try_("disk", fill)
        raise SystemExit("done")
"""


@each_sandbox
def test_a_sandbox_refuses_what_an_attacker_tries(tmp_path, name):
    secret, beside, agent = tmp_path / "salt", tmp_path / "written", tmp_path / "agent"
    secret.write_text("a secret salt")
    agent.mkdir()
    source = ATTACKS.format(parent=os.getpid(), secret=str(secret), beside=str(beside))
    (agent / "agent.py").write_text(textwrap.dedent(source))
    before = {path: path.stat().st_mtime for path in tmp_path.rglob("*")}
    child = Child(choice.BACKENDS[name], agent, _SETUP, Budget())
    with pytest.raises(AgentFailure, match="done"):
        child.ask({"do": "reset"}, [], 20.0)
    lines = bytes(child.words).decode().splitlines()
    tried = [line for line in lines if line and not line.startswith((" ", "Traceback", "SystemExit"))]
    assert len(tried) == source.count("try_(") - 1
    assert [line for line in tried if " ok" in line] == []
    assert {path: path.stat().st_mtime for path in tmp_path.rglob("*")} == before
    assert secret.read_text() == "a secret salt"


def test_without_a_sandbox_the_same_attempts_succeed():
    found = probe.probe_backend(open_door)
    assert not found.works
    # memory alone is limited without a sandbox, too
    assert set(found.let_through) == set(ATTEMPTS) - {"4 GB of memory"}
    assert "lets through read a file" in str(found)


@each_sandbox
def test_a_sandbox_that_works_says_what_it_refuses(name):
    assert probe.probe_backend(choice.BACKENDS[name]) is choice.probe_all()[name]  # tried once per process
    assert all(attempt in str(choice.probe_all()[name]) for attempt in ATTEMPTS)


def test_the_first_sandbox_that_works_is_chosen_and_none_is_refused(monkeypatch):
    def broken(folder: Path) -> Start:
        raise SandboxError("it is broken")

    def leaky(folder: Path) -> Start:
        return open_door(folder)

    monkeypatch.setattr(choice, "BACKENDS", {"one": broken, "two": leaky, "none": open_door})
    with pytest.raises(
        SandboxError, match=r"(?s)one: it is broken.*two: lets through.*apt install bubblewrap"
    ):
        choice.sandbox()
    if WORKING:
        works = {"bubblewrap": bubblewrap.start, "landlock": landlock.start}[WORKING[0]]
        monkeypatch.setattr(choice, "BACKENDS", {"one": broken, "two": works, "none": open_door})
        assert choice.sandbox() == "two"


def test_where_bwrap_is_missing_the_line_that_mends_it_is_named(monkeypatch, tmp_path):
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(SandboxError, match="apt install bubblewrap"):
        bubblewrap.start(tmp_path)


def test_an_environment_in_tmp_stays_visible(monkeypatch, tmp_path):
    """Where packages lie below /tmp, the child's own /tmp must not hide them."""
    agent, more = tmp_path / "agent", tmp_path / "more"
    agent.mkdir()
    more.mkdir()
    (more / "installed_module.py").write_text("")
    (agent / "agent.py").write_text("import installed_module\nraise SystemExit('found')\n")
    for name in WORKING:
        module = {"bubblewrap": bubblewrap, "landlock": landlock}[name]
        known = module.packages()
        monkeypatch.setattr(module, "packages", lambda known=known: [*known, more])
        with pytest.raises(AgentFailure, match="found"):
            Child(choice.BACKENDS[name], agent, _SETUP, Budget()).ask({"do": "reset"}, [], 20.0)


def test_a_child_that_cannot_start_is_the_hosts_fault(tmp_path):
    for command, reason in (
        ([str(tmp_path / "no-such-program")], "could not be started"),
        ([sys.executable, "-c", "raise SystemExit('no user namespaces')"], "no user namespaces"),
    ):
        with pytest.raises(HostFailure, match=reason):
            Child(lambda folder, command=command: Start(command, {}), tmp_path, {}, Budget()).ask({}, [], 9.0)


def test_messages_larger_than_a_pipe_pass_both_ways(tmp_path):
    (tmp_path / "agent.py").write_text(
        "class Agent:\n    def reset(self, seeds): pass\n    def act(self, seen, alive): return seen * 2\n"
        "def make_agent(task, seed): return Agent()\n"
    )
    child = Child(open_door, tmp_path, _SETUP, Budget())
    child.ask({"do": "reset"}, [bytes(8)], 10.0)
    seen = np.arange(1_000_000, dtype=np.float32).reshape(10, 10, 10_000)  # 4 MB there, 8 MB back
    header, payload = child.ask(
        {"do": "act", "shape": seen.shape}, [seen.data, bytes(100)], 20.0, most=seen.size * 8
    )
    assert header["shape"] == [10, 10, 10_000]
    assert (np.frombuffer(payload, np.float64).reshape(seen.shape) == seen * 2.0).all()
    child.kill()


@each_sandbox
def test_children_are_gone_when_they_are_dropped_and_when_their_parent_is_killed(tmp_path, name):
    mark = f"x{tmp_path.name}-{time.time_ns()}"
    folder = tmp_path / mark
    folder.mkdir()
    (folder / "agent.py").write_text("while True: pass\n")
    parent = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(f"""
            import sys
            from pathlib import Path
            from hipg_bench.sandbox import choice
            from hipg_bench.sandbox.budget import Budget
            from hipg_bench.sandbox.process import Child
            entry = {{"entry_point": "agent:make_agent"}}
            setup = {{"runner": "python_runner", "options": entry, "task": {{}}, "train_seed": 0}}
            child = Child(choice.BACKENDS[{name!r}], Path({str(folder)!r}), setup, Budget())
            print(child._process.pid, flush=True)
            child.ask({{"do": "reset"}}, [], 60.0)
        """)],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    child = int(parent.stdout.readline())
    family = descendants(parent.pid)
    assert child in family
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    deadline = time.monotonic() + 5.0
    while any(_alive(pid) for pid in family) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert [pid for pid in family if _alive(pid)] == []


def _alive(pid):
    """Whether it runs; what only waits to be reaped does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def test_the_doctor_says_how_each_sandbox_did(monkeypatch):
    fine, broken = probe.ProbeResult(seconds=0.3), probe.ProbeResult(trouble="bwrap is not installed")
    monkeypatch.setattr(choice, "probe_all", lambda: {"bubblewrap": broken, "landlock": fine})
    found = {finding.name: finding for finding in doctor._sandbox()}
    assert [finding.level for finding in found.values()] == ["note", "ok"]
    assert found["sandbox bubblewrap"].fix == "apt install bubblewrap"
    assert "refuses read a file" in found["sandbox landlock"].text
    leaky = probe.ProbeResult(("TCP",))
    monkeypatch.setattr(choice, "probe_all", lambda: {"bubblewrap": broken, "landlock": leaky})
    findings = list(doctor._sandbox())
    assert [finding.level for finding in findings] == ["warning", "warning"]  # built-in agents can be scored
    assert "lets through TCP" in findings[1].text
