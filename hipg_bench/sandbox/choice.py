"""Which sandbox is used on this machine: the first that did its work when it was tried."""

from __future__ import annotations

from collections.abc import Mapping

from hipg_bench.errors import SandboxError
from hipg_bench.sandbox import bubblewrap, landlock, probe
from hipg_bench.sandbox.backend import Backend, open_door

NONE = "none"
BACKENDS: Mapping[str, Backend] = {
    "bubblewrap": bubblewrap.start, "landlock": landlock.start, NONE: open_door
}  # fmt: skip
"""By name, the best first; the last one locks nothing."""


def probe_all() -> Mapping[str, probe.ProbeResult]:
    """What each sandbox was worth when tried."""
    return {name: probe.probe_backend(backend) for name, backend in BACKENDS.items() if name != NONE}


def sandbox() -> str:
    """Name of the first sandbox that works.

    Raises:
        SandboxError: none does; the message says what each let through.
    """
    trouble: list[str] = []
    for name, backend in BACKENDS.items():
        if name == NONE:
            continue
        found = probe.probe_backend(backend)
        if found.works:
            return name
        trouble.append(f"  {name}: {found}")
    raise SandboxError(
        "code of others is not run without a sandbox, and none works on this machine:\n"
        + "\n".join(trouble)
        + "\nInstall bubblewrap (apt install bubblewrap), or run where user namespaces are allowed. "
        "Agents that you wrote yourself may run with `--trust`; their results are never verified."
    )
