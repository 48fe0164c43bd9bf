# Sourced by tools/demo, tools/test, tools/bench and tools/servo: makes or reuses a virtual environment with this checkout installed in it.
# GRIPMON_VENV: where (default .venv in the checkout).  PYTHON: which interpreter (default: the first one that is new enough).

checkout=$(cd "$(dirname "${BASH_SOURCE[0]}")/.." && pwd)
venv=${GRIPMON_VENV:-$checkout/.venv}

say() { printf '%s\n' "$*" >&2; }

find_python() {
    local candidate found=""
    for candidate in ${PYTHON:-python3 python3.14 python3.13 python3.12 python3.11}; do
        command -v "$candidate" >/dev/null 2>&1 || continue
        found=${found:-$candidate}
        if "$candidate" -c 'import sys; sys.exit(sys.version_info < (3, 11))'; then
            python=$candidate
            return
        fi
    done
    if [ -z "$found" ]; then
        say "gripmon needs Python 3.11 or newer, and there is no ${PYTHON:-python3}; on Debian or Ubuntu: sudo apt install python3 python3-venv"
    else
        say "gripmon needs Python 3.11 or newer, and $found is $("$found" -c 'import platform; print(platform.python_version())');" \
            "install a newer one beside it (e.g. python3.12 and python3.12-venv), or name it: PYTHON=/path/to/python $0"
    fi
    exit 2
}

# ensure_venv EXTRAS: install the package with "", "[test]" or "[bench]" unless that was done with this very pyproject.toml
ensure_venv() {
    local extras=$1 stamp want
    stamp=$venv/.installed$extras
    want=$(cat "$checkout/pyproject.toml" "$checkout/gripmon/__init__.py" | cksum)" $checkout"
    if "$venv/bin/python" -c '' 2>/dev/null && { [ "$(cat "$stamp" 2>/dev/null)" = "$want" ] ||
        { [ -z "$extras" ] && [ "$(cat "$venv/.installed[test]" 2>/dev/null)" = "$want" ]; }; }; then
        return
    fi
    find_python
    if ! "$python" -c 'import venv, ensurepip' 2>/dev/null; then
        say "$python can't make virtual environments; on Debian or Ubuntu: sudo apt install" \
            "$("$python" -c 'import sys; print(f"python{sys.version_info[0]}.{sys.version_info[1]}-venv")')"
        exit 2
    fi
    say "Installing gripmon$extras into $venv (once; a minute or two, 1.5 GB on disk) …"
    "$venv/bin/python" -c '' 2>/dev/null || "$python" -m venv --clear "$venv"
    "$venv/bin/python" -m pip install --quiet --disable-pip-version-check --editable "$checkout$extras"
    printf '%s\n' "$want" >"$stamp"
}
