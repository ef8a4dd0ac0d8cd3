#!/usr/bin/env bash
# Compares our speed with that of other libraries, in an environment of its own, .venv-peers.
#
#   scripts/bench_peers.sh --only spread --rounds 9
set -euo pipefail
cd "$(dirname "$0")/.."

readonly ENV=.venv-peers READY=.venv-peers/.ready
if [ ! -e $READY ] || [ scripts/peers/requirements.txt -nt $READY ] || [ constraints.txt -nt $READY ]; then
    printf 'bench-peers: making %s (a few minutes the first time)\n' $ENV >&2
    .venv/bin/python -m venv --clear $ENV
    # torch by itself first: where an index with the small CPU build is configured, that one is taken
    $ENV/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt "$(grep -E '^torch==' constraints.txt)"
    $ENV/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt \
        -r scripts/peers/requirements.txt -e '.[torchrl]'
    touch $READY
fi
exec $ENV/bin/python scripts/peers/compare.py "$@"
