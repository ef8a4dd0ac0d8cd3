#!/usr/bin/env bash
# Makes the checkout ready: a virtual environment in .venv with the pinned packages, and the system
# libraries that render video without a screen. Safe to run again; `make` runs it when it is needed.
#
#   PYTHON=python3.12 scripts/setup.sh    use this Python instead of the newest one found
#   scripts/setup.sh --docs               the packages that build the documentation site
#   scripts/setup.sh --tests              these, a browser and a virtual display, which only the tests use
set -euo pipefail
cd "$(dirname "$0")/.."

say() { printf 'setup: %s\n' "$*" >&2; }

# --- apt, where there is one and we may use it ------------------------------------------------------
may_apt() {
    command -v apt-get >/dev/null || return 1
    [ "$(id -u)" = 0 ] || sudo -n true 2>/dev/null
}

as_root() {
    if [ "$(id -u)" = 0 ]; then "$@"; else sudo -n "$@"; fi
}

# one by one: a release that dropped one of the packages still gets the others
apt_install() {
    as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq update || say "apt-get update failed; going on"
    local package
    for package in "$@"; do
        as_root env DEBIAN_FRONTEND=noninteractive apt-get -qq install -y --no-install-recommends \
            "$package" >/dev/null || say "could not install $package"
    done
}

# --- Python >= 3.11 ---------------------------------------------------------------------------------
new_enough() { "$1" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; }

find_python() {
    local candidate
    for candidate in ${PYTHON:-python3.13 python3.12 python3.11 python3}; do
        if command -v "$candidate" >/dev/null && new_enough "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    say "Python 3.11 or newer is needed, and none was found (tried: ${PYTHON:-python3.13 python3.12 python3.11 python3})."
    say "On Debian 12 or newer and Ubuntu 24.04 or newer:  sudo apt-get install python3 python3-venv"
    return 1
}

make_venv() {
    if [ -x .venv/bin/python ] && new_enough .venv/bin/python; then return; fi
    local python version
    python=$(find_python)
    version=$("$python" -c 'import sys; print(f"{sys.version_info.major}.{sys.version_info.minor}")')
    if ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        if may_apt; then
            say "installing python$version-venv"
            apt_install "python$version-venv"
        else
            say "$python cannot make virtual environments. Install that:  sudo apt-get install python$version-venv"
            return 1
        fi
    fi
    say "making .venv with Python $version"
    "$python" -m venv --clear .venv
}

install_packages() {
    local torch
    torch=$(grep -E '^torch==' constraints.txt)
    say "installing the packages pinned in constraints.txt (a few minutes the first time)"
    # torch by itself first: where an index with the small CPU build is configured, that one is taken
    .venv/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt "$torch"
    .venv/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[dev]'
}

# --- libraries for offscreen rendering --------------------------------------------------------------
install_gl() {
    local known missing=() library package
    known=$(PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null || true)
    while read -r library package; do
        grep -q "$library" <<<"$known" || missing+=("$package")
    done <<'LIBRARIES'
libEGL.so.1       libegl1
libEGL_mesa.so.0  libegl-mesa0
libOpenGL.so.0    libopengl0
libGL.so.1        libgl1
libOSMesa.so      libosmesa6
LIBRARIES
    if [ ${#missing[@]} = 0 ]; then return; fi
    if may_apt; then
        say "installing libraries for video: ${missing[*]}"
        apt_install "${missing[@]}" libgl1-mesa-dri
    else
        say "video needs libraries that are missing here; all but video works without. To add them:"
        say "    sudo apt-get install ${missing[*]} libgl1-mesa-dri"
    fi
}

# --- what shuts submitted agents in -----------------------------------------------------------------
install_sandbox() {
    if command -v bwrap >/dev/null || [ "$(uname)" != Linux ]; then return; fi
    if may_apt; then
        say "installing bubblewrap, the sandbox of submitted agents"
        apt_install bubblewrap
    else
        say "agents that bring code need a sandbox. To add it:  sudo apt-get install bubblewrap"
    fi
}

# --- what only the tests use ------------------------------------------------------------------------
install_for_tests() {
    local missing=()
    command -v chromium >/dev/null || command -v chromium-browser >/dev/null || command -v google-chrome >/dev/null ||
        missing+=(chromium)
    command -v xvfb-run >/dev/null || missing+=(xvfb xauth)
    if [ ${#missing[@]} = 0 ]; then return; fi
    if may_apt; then
        say "installing a browser and a virtual display for the tests: ${missing[*]}"
        apt_install "${missing[@]}"
    else
        say "some tests need ${missing[*]} and will be skipped. To add them:  sudo apt-get install ${missing[*]}"
    fi
}

# --- what builds the documentation site -------------------------------------------------------------
install_for_docs() {
    .venv/bin/python -m pip install -qq --disable-pip-version-check -c constraints.txt -e '.[docs]'
    touch .venv/.docs-ready
}

if [ "${1:-}" = --docs ]; then
    install_for_docs
    exit
fi
if [ "${1:-}" = --tests ]; then
    install_for_docs
    install_for_tests
    touch .venv/.tests-ready
    exit
fi
make_venv
install_packages
install_gl
install_sandbox
touch .venv/.ready
say "done; .venv/bin/hipg-bench doctor tells what works here"
