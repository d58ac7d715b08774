#!/usr/bin/env bash
# Everything a fresh machine needs: uv, Python 3.12, .venv with the locked packages (those of the extra `maniskill`
# too), this project, a renderer, FFmpeg's libraries.
# Each step is skipped when it is done, so a second call takes a second or two. Nothing is asked.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source tools/packages.sh

venv_python=.venv/bin/python

runs_312() {
    "$1" -c 'import sys; raise SystemExit(sys.version_info[:2] != (3, 12))' >/dev/null 2>&1
}

# Prints a real interpreter 3.12, or nothing. A pyenv shim exists for versions that are not active, so each
# candidate has to run; and uv stops at such a shim, so it is given the interpreter behind it.
find_python() {
    local candidate root
    root=$(pyenv root 2>/dev/null || echo "${PYENV_ROOT:-$HOME/.pyenv}")
    for candidate in python3.12 "$root"/versions/3.12*/bin/python python3 python; do
        if runs_312 "$candidate"; then
            "$candidate" -c 'import sys; print(sys._base_executable)'
            return
        fi
    done
}

# Prints a uv that runs: the one on the PATH, else one of our own in .uv/ (no system package is touched).
find_uv() {
    local candidate
    for candidate in uv .uv/bin/uv "$HOME/.local/bin/uv"; do
        if "$candidate" --version >/dev/null 2>&1; then
            command -v "$candidate"
            return
        fi
    done
    install_uv >&2 || return 1
    echo .uv/bin/uv
}

# With `venv` where Python has it, else with a pip that installs into a folder; Debian and Ubuntu ship
# Python without both, so that their package is the last resort.
install_uv() {
    local python
    python=$(find_python)
    python=${python:-$(command -v python3 || true)}
    echo "setup: installing uv into .uv/"
    rm -rf .uv
    if [ -n "$python" ] && { install_uv_in_venv "$python" || install_uv_with_pip "$python"; }; then
        return
    fi
    as_root "Python's venv module, which installs uv" sh -c "apt-get update && apt-get install -y python3-venv" &&
        install_uv_in_venv /usr/bin/python3
}

install_uv_in_venv() {
    rm -rf .uv
    "$1" -m venv .uv 2>/dev/null && .uv/bin/python -m pip install --quiet uv
}

install_uv_with_pip() {
    rm -rf .uv
    "$1" -m pip install --quiet --target .uv uv 2>/dev/null
}

make_venv() {
    runs_312 "$venv_python" && return
    local python uv
    python=$(find_python)
    uv=$(find_uv)
    "$uv" venv --clear --python "${python:-3.12}" .venv
}

# install_once NAME FILES COMMAND...: run COMMAND unless it succeeded before for the same content of FILES.
install_once() {
    local stamp=".venv/.installed-$1" content
    content=$(cat $2 | sha256sum)
    shift 2
    if [ "$(cat "$stamp" 2>/dev/null)" != "$content" ]; then
        "$@"
        echo "$content" >"$stamp"
    fi
}

install_locked_packages() {
    local uv
    uv=$(find_uv)
    # Compiled once here: a command imports thousands of modules, and some machines keep Python from caching them.
    "$uv" pip sync --python "$venv_python" --compile-bytecode --require-hashes requirements.lock
    rm -f .venv/.installed-project # uv removed it: it is not in the lock
}

install_project() {
    local uv
    uv=$(find_uv)
    "$uv" pip install --python "$venv_python" --no-deps --no-build-isolation --editable .
}

# torchcodec, LeRobot's video decoder, loads the system's FFmpeg, and prints a hundred lines where there is none.
# LeRobot then decodes with the FFmpeg that PyAV ships, so that the set-up goes on without.
ensure_ffmpeg() {
    local ldconfig
    ldconfig=$(PATH="$PATH:/sbin:/usr/sbin" command -v ldconfig) || return 0
    if ! "$ldconfig" -p | grep -q 'libavdevice\.so'; then
        as_root "FFmpeg's libraries, for torchcodec" \
            sh -c "apt-get update && apt-get install -y --no-install-recommends ffmpeg" || true
    fi
}

make_venv
install_once packages requirements.lock install_locked_packages
install_once project pyproject.toml install_project
tools/ensure_renderer.sh
ensure_ffmpeg
