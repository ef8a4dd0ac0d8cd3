#!/usr/bin/env bash
# Tests the adapter of a library that cannot share an environment with the others, in .venv-<name>, which is made
# on the first run (a few minutes). What follows the name goes to pytest.
#
#   scripts/test_beside.sh rllib         ray pins gymnasium 1.2: our oldest, so its adapters are tested here too
#   scripts/test_beside.sh benchmarl     it pins TorchRL 0.11, whose adapter is tested here too
#   PYTHON=python3.12 scripts/...        use this Python instead of that of .venv, or the newest one found
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf 'test_beside: %s\n' "$*" >&2; }

name=${1:-}
case $name in
    rllib) library='ray[rllib]' other=gymnasium ;;
    benchmarl) library=benchmarl other=torchrl ;;
    *) say "rllib or benchmarl, got '$name'" && exit 2 ;;
esac
shift
venv=.venv-$name pins=scripts/constraints-$name.txt

new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }

find_python() {
    local candidate
    for candidate in ${PYTHON:-.venv/bin/python python3.13 python3.12 python3.11 python3}; do
        if command -v "$candidate" >/dev/null && new_enough "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    say "Python 3.11 or newer is needed, and none was found"
    return 1
}

install() { "$venv/bin/python" -m pip install -qq --disable-pip-version-check -c "$pins" "$@"; }

if [ ! "$venv/.ready" -nt "$pins" ] || [ ! "$venv/.ready" -nt pyproject.toml ]; then
    python=$(find_python)
    say "making $venv with $python and the packages pinned in $pins (a few minutes)"
    "$python" -m venv --clear "$venv"
    # torch by itself first: where an index with the small CPU build is configured, that one is taken
    install "$(grep -E '^torch==' "$pins")"
    install "$library" pytest beartype -e .
    touch "$venv/.ready"
fi

exec "$venv/bin/python" -m pytest tests/adapters/test_truth_table.py tests/adapters/test_agreement.py \
    "tests/adapters/test_adapter_$name.py" "tests/adapters/test_adapter_$other.py" tests/test_readme.py -k "$name or $other" "$@"
