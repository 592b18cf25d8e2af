#!/usr/bin/env bash
# Set up what `make demo` and `make test` need: a virtual environment with the package, and software rendering.
# With the argument `tests`, also Slurm, for the sweep tests. A second run finds its stamp and does nothing.
# PYTHON=python3.12 chooses the interpreter; an environment with another version is rebuilt. By default, an existing
# environment keeps its version.
set -euo pipefail
cd "$(dirname "$0")/.."

VENV=.venv
if [ -z "${PYTHON:-}" ]; then
    PYTHON=python3
    [ ! -x "$VENV/bin/python" ] || PYTHON="$VENV/bin/python"
fi
STAMP="$VENV/.installed"
RENDER_PACKAGES=(libegl1 libgl1 libgl1-mesa-dri)
if [ "${MUJOCO_GL:-}" = osmesa ]; then
    RENDER_PACKAGES=(libosmesa6)
fi

say() { printf '%s\n' "$*" >&2; }

# Install Debian packages as root or with passwordless sudo; otherwise name them in one line and stop.
install_debian() {
    local as_root=""
    if ! command -v apt-get >/dev/null; then
        say "setup: needs $*: install with your system's package manager, then re-run the same command"
        exit 2
    fi
    if [ "$(id -u)" -ne 0 ]; then
        if ! sudo -n true 2>/dev/null; then
            say "setup: please install $* (for example: sudo apt-get install $*), then re-run the same command"
            exit 2
        fi
        as_root="sudo -n"
    fi
    say "setup: installing $*"
    $as_root apt-get update -qq >/dev/null
    $as_root env DEBIAN_FRONTEND=noninteractive apt-get install -y -qq "$@" >/dev/null
}

# The sweep tests start their own Slurm, as root; they are skipped if it cannot be installed.
install_slurm() {
    if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null && ! command -v slurmd >/dev/null; then
        (install_debian --no-install-recommends slurmctld slurmd slurm-client munge) 2>/dev/null || say "setup: no Slurm"
    fi
}

version() { "$1" -V 2>/dev/null || true; }

wanted="$(cat pyproject.toml constraints.txt tools/setup.sh | cksum) $(version "$PYTHON")"
[ "${1:-}" != tests ] || install_slurm
if [ -f "$STAMP" ] && [ "$(cat "$STAMP")" = "$wanted" ]; then
    exit 0
fi

if ! command -v "$PYTHON" >/dev/null; then
    install_debian python3 python3-venv
fi
if ! "$PYTHON" -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 14))'; then
    say "setup: $PYTHON is $("$PYTHON" -V), one of 3.11 to 3.13 is needed; name it with PYTHON=python3.12"
    exit 2
fi
if [ "$(version "$VENV/bin/python")" != "$(version "$PYTHON")" ]; then
    "$PYTHON" -c 'import ensurepip, venv' 2>/dev/null || install_debian python3-venv
    "$PYTHON" -m venv --clear "$VENV"
fi
say "setup: installing Python packages (a few minutes the first time)"
pip_install() { "$VENV/bin/python" -m pip install --quiet --disable-pip-version-check -c constraints.txt "$@"; }
pip_install -e ".[dev,navigation,policy,tracking,slurm,ray]"
pip_install --no-deps dm-control # on Python 3.13 only this works; elsewhere it is installed already

# Whether a task can be rendered here; sets `failure`, the last line of its output.
can_render() {
    failure="$("$VENV/bin/python" -c 'from vd4rl_pomdp.core.tasks import TASKS
from vd4rl_pomdp.envs.make import make_env
assert make_env(TASKS["walker_walk"]).reset(0).frame is not None' 2>&1 | tail -n 1)"
}
if ! can_render; then
    ! command -v apt-get >/dev/null || install_debian "${RENDER_PACKAGES[@]}"
    if ! can_render; then
        say "setup: rendering fails: ${failure##*UserError: }"
        exit 2
    fi
fi
printf '%s' "$wanted" >"$STAMP"
