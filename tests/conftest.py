"""What the whole suite shares: shape checks on every call, one BLAS thread, the golden switch."""

import os

# one thread for the numerical libraries: the machine's cores belong to the physics and to other tests
os.environ.setdefault("OMP_NUM_THREADS", "1")

import jaxtyping

# before hipg_bench is imported: every annotated shape and type of the package is checked in every test
jaxtyping.install_import_hook("hipg_bench", "shape_checks.check")

import pytest  # noqa: E402


def pytest_addoption(parser: pytest.Parser) -> None:
    """`make golden` records what `make test` compares."""
    parser.addoption("--record-golden", action="store_true", help="record the golden episodes again")
    parser.addoption(
        "--strict-golden", action="store_true", help="fail where golden episodes cannot be compared"
    )
