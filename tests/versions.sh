#!/usr/bin/env bash
# Installs gen2d in fresh virtual environments and runs it there: the main job, a repair, and tests that touch many libraries.
#   tests/versions.sh [lowest] [newest] [sdist]    all three if none is named
#     lowest   the lowest versions that pyproject.toml allows, of dependencies and extras alike
#     newest   `pip install .` alone, then the extras: the newest versions that there are
#     sdist    the source distribution and the wheel built from it, as users get them
# PYTHONS="3.11 3.13" chooses interpreters. Those that are not here are named as 'not run'. The last lines are a table.
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
export PIP_DISABLE_PIP_VERSION_CHECK=1 PIP_QUIET=2
unset PYTHONPATH

# Loading, datasets, exports, images, servers, clusters, configs, joints (SciPy), rendering, and Box2D and pymunk.
tests="loading/test_dataset.py loading/test_dataloader.py loading/test_frameworks.py loading/test_torch.py dataset/test_shards.py
    dataset/test_cards.py exports/test_exports.py media/test_images.py storage/test_codecs.py storage/test_remote.py
    engines/test_engines.py config/test_config.py physics/test_rigid_joints.py renderers/test_camera.py"

interpreter() { # path of the Python with this version, or nothing
    local path
    for path in "python$1" "${PYENV_ROOT:-$HOME/.pyenv}/versions/$1".*/bin/python; do
        if [ "$("$path" -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>&1)" = "$1" ]; then
            command -v "$path"
            return
        fi
    done
}

main_job() { # far from the checkout
    mkdir "$work/job"
    cd "$work/job"
    python -m gen2d --config bouncing.yaml --n 20 --out data
    python -m gen2d verify data
    python - <<'PY'
import pathlib
shard = sorted(pathlib.Path("data/shards").iterdir())[0]
content = bytearray(shard.read_bytes())
content[len(content) // 2] ^= 1
shard.write_bytes(content)
PY
    if python -m gen2d verify data; then return 1; fi
    python -m gen2d verify data --repair
    python -m gen2d verify data
    cd "$work"
    rm -r job
}

fast_tests() { # of the checkout, on the installed gen2d
    mkdir "$work/copy"
    cp -r "$root/tests" "$root/pyproject.toml" "$work/copy"
    cd "$work/copy/tests"
    # Old versions of libraries warn of what newer ones removed.
    pytest -q -n 0 -p no:cacheprovider --durations=15 $1 $tests
    cd "$work"
    rm -r copy
}

lowest() {
    pip install packaging
    floors() { python "$root/tests/support/floors.py" "$@"; }
    floors >floors.txt
    pip install -r floors.txt "$root"
    main_job
    floors dev >floors.txt
    pip install -r floors.txt
    fast_tests "-W default::DeprecationWarning -W default::FutureWarning"
}

newest() {
    pip install "$root"
    main_job
    pip install "$root[dev]" packaging
    fast_tests ""
}

sdist() {
    python -m venv tools
    tools/bin/pip install build twine
    tools/bin/python -m build --outdir dist "$root"
    tools/bin/twine check --strict dist/*
    pip install dist/gen2d-*.tar.gz
    main_job
    python "$root/tests/wheel.py" dist/gen2d-*.whl
    pip install packaging
}

status=0 ran=0
for section in ${*:-lowest newest sdist}; do
    for version in ${PYTHONS:-3.11 3.12 3.13}; do
        python=$(interpreter "$version")
        if [ -z "$python" ]; then
            echo "not run: Python $version" | tee -a "$work/table"
            continue
        fi
        began=$SECONDS ran=1
        rm -rf "$work/env" "$work/job" "$work/copy" "$work/dist" "$work/tools"
        "$python" -m venv "$work/env"
        result=0
        # Not in a condition: `set -e` would not hold in it.
        set +e
        (
            set -e
            . "$work/env/bin/activate"
            cd "$work"
            $section
        ) >"$work/log" 2>&1
        result=$?
        set -e
        tests_line=$(grep -E "^[0-9]+ passed|^[0-9]+ failed" "$work/log" || true)
        versions=$("$work/env/bin/python" "$root/tests/support/floors.py" --installed 2>/dev/null || true)
        if [ $result = 0 ]; then outcome=works; else outcome=FAILS status=1; tail -n 60 "$work/log"; fi
        echo "$section | Python $version | $outcome | ${tests_line:-no tests} | $((SECONDS - began)) s | $versions" |
            tee -a "$work/table"
    done
done
if [[ "${*:-lowest}" == *lowest* ]]; then
    echo "not run: the extras cuda and torch at their lowest, whose wheels hold gigabytes for GPUs"
fi
echo "== table"
cat "$work/table"
[ $ran = 1 ] || exit 1
exit $status
