#!/usr/bin/env bash
# The tests on Windows' Python under Wine: bash tools/windows_tests.sh [--limit SECONDS] [--all | PATH...]
#
# Without paths, what takes two or three minutes; with --all, the suite: file by file, as many at a time as there are
# processors. tests/not_on_windows.toml says what is left out, and why. The last line says what share of the tests that
# run on Linux ran. Where Wine cannot be had, or does not start, one line says so, and the exit code is 0. When the time
# is up, a line says what has not run. URLAB_WINDOWS names a folder to keep the interpreter and the output in.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1

SUBSET=(
    tests/test_mujoco_releases.py tests/test_not_on_windows.py
    tests/protocol
    tests/aio/test_readiness.py tests/aio/test_busy_loops.py tests/aio/test_stream_buffer.py
    tests/server/test_debug_ops.py
)
PACKAGES=(wine wine64 gcc-mingw-w64-x86-64 xvfb libgl1 libgl1-mesa-dri libxcomposite1 libxcursor1 libxi6 libxrandr2)

limit=1000000
if [[ ${1:-} == --limit ]]; then
    limit=$2
    shift 2
fi
tests=("${@:-${SUBSET[@]}}")
[[ ${1:-} != --all ]] || tests=(tests)

not_run() {
    printf 'the tests on Windows were not run: %s\n' "$1"
    exit 0
}

# within SECONDS COMMAND...: run it, for so long at most, and no longer than there is time at all.
within() {
    local seconds=$1 left=$((limit - SECONDS))
    shift
    ((left > 0)) || not_run "the time of $limit s was up"
    timeout --kill-after=10 "$((seconds < left ? seconds : left))" "$@" </dev/null
}

scratch=$(mktemp -d)
trap 'rm -rf "$scratch"' EXIT

for program in wine x86_64-w64-mingw32-gcc Xvfb; do
    if ! command -v "$program" >/dev/null; then
        [[ $(id -u) == 0 ]] && command -v apt-get >/dev/null || not_run "$program is missing, and cannot be installed here"
        export DEBIAN_FRONTEND=noninteractive
        options=(-qq -o Acquire::http::Timeout=20 -o Acquire::Retries=1)
        printf 'Windows: %s is missing; installing %s\n' "$program" "${PACKAGES[*]}"
        { within 60 apt-get "${options[@]}" update &&
            within 180 apt-get "${options[@]}" install -y --no-install-recommends "${PACKAGES[@]}"; } \
            >"$scratch/packages" 2>&1 || { tail -n 5 "$scratch/packages" && not_run 'Wine cannot be installed'; }
        break
    fi
done
[[ -d /usr/lib/python3.11 ]] || not_run 'there is no /usr/lib/python3.11, whose standard library would be used'

folder=${URLAB_WINDOWS:-$scratch/windows}
bash tools/windows/make_python.sh "$folder" "$((limit - SECONDS))" || not_run 'the interpreter for Windows could not be made'

# The Python of this system that says which tests run on Linux.
python=.venv/bin/python
if ! "$python" -c 'import pytest, urlab_client' 2>/dev/null; then
    python=$scratch/linux/bin/python
    printf 'Windows: installing the dependencies of the tests on Linux\n'
    within 300 bash -c 'python3 -m venv "$1" && "$2" -m pip install -q -e ".[test,demo]"' - "$scratch/linux" "$python" ||
        not_run 'the dependencies of the tests on Linux could not be installed'
fi

((limit > SECONDS)) || not_run "the time of $limit s was up"
"$python" tools/windows/run_tests.py "$folder/winpy" "$python" --limit "$((limit - SECONDS))" --logs "$folder/logs" \
    "${tests[@]}"
