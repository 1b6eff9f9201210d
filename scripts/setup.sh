# Sourced by the scripts beside it: makes or reuses the repository's one environment, .venv, and changes to the
# repository's root. Set PYTHON to choose the interpreter (3.11 or newer) that makes it.
cd "$(dirname "${BASH_SOURCE[0]}")/.."

if ! .venv/bin/python -c 'import sys' >/dev/null 2>&1; then
    for python in ${PYTHON:-python3.11 python3 python}; do
        if "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' >/dev/null 2>&1; then
            break
        fi
        python=
    done
    if [ -z "$python" ]; then
        echo "torchfovea needs Python 3.11 or newer: set PYTHON to one" >&2
        exit 1
    fi
    rm -rf .venv
    "$python" -m venv .venv
fi

# The stamp names what was installed: as long as it stands, a second run installs nothing.
stamp=$(.venv/bin/python - <<'PY'
import hashlib, pathlib, sys
files = ("pyproject.toml", "constraints.txt", "scripts/setup.sh")
text = b"".join(pathlib.Path(f).read_bytes() for f in files) + sys.version.encode() + str(pathlib.Path().resolve()).encode()
print(hashlib.sha256(text).hexdigest())
PY
)
if [ "$(cat .venv/torchfovea.stamp 2>/dev/null)" != "$stamp" ]; then
    rm -f .venv/torchfovea.stamp
    # torch first and by itself: otherwise a dependency may choose another build of it.
    .venv/bin/python -m pip install --quiet -c constraints.txt "torch==$(sed -n 's/^torch==//p' constraints.txt)"
    .venv/bin/python -m pip install --quiet -c constraints.txt -e '.[all,dev]'
    echo "$stamp" >.venv/torchfovea.stamp
fi
