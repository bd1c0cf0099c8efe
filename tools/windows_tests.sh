#!/usr/bin/env bash
# The tests on Windows' Python under Wine: bash tools/windows_tests.sh [--all | PATH...]
#
# Without arguments, what takes two or three minutes; with --all, the suite: file by file, as many at a time as there
# are processors. tests/not_on_windows.toml says what is left out, and why. The last line says what share of the tests
# that run on Linux ran. Where Wine cannot be had, one line says so, and the exit code is 0.
# URLAB_WINDOWS names a folder to keep the interpreter and the output in.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1

SUBSET=(
    tests/test_mujoco_releases.py tests/test_not_on_windows.py
    tests/protocol
    tests/aio/test_readiness.py tests/aio/test_busy_loops.py tests/aio/test_stream_buffer.py
    tests/server/test_debug_ops.py
)
PACKAGES=(wine wine64 gcc-mingw-w64-x86-64 xvfb libgl1 libgl1-mesa-dri libxcomposite1 libxcursor1 libxi6 libxrandr2)

not_run() {
    printf 'the tests on Windows were not run: %s\n' "$1"
    exit 0
}

for program in wine x86_64-w64-mingw32-gcc Xvfb; do
    if ! command -v "$program" >/dev/null; then
        [[ $(id -u) == 0 ]] && command -v apt-get >/dev/null || not_run "$program is missing, and cannot be installed here"
        export DEBIAN_FRONTEND=noninteractive
        { apt-get update -qq && apt-get install -y -qq --no-install-recommends "${PACKAGES[@]}"; } \
            >/dev/null 2>&1 || not_run 'wine cannot be installed'
        break
    fi
done
[[ -d /usr/lib/python3.11 ]] || not_run 'there is no /usr/lib/python3.11, whose standard library would be used'

scratch=$(mktemp -d)
screen=
ended() {
    [[ -z $screen ]] || kill "$screen"
    rm -rf "$scratch"
}
trap ended EXIT
folder=${URLAB_WINDOWS:-$scratch/windows}
bash tools/windows/make_python.sh "$folder" || not_run 'the interpreter for Windows could not be made'

# The Python of this system that says which tests run on Linux.
python=.venv/bin/python
if ! "$python" -c 'import pytest, urlab_client' 2>/dev/null; then
    python=$scratch/linux/bin/python
    python3 -m venv "$scratch/linux" && "$python" -m pip install -q -e '.[test,demo]' || exit 1
fi

# Without a screen Wine draws nothing: one in memory.
mkfifo "$scratch/display"
Xvfb -displayfd 3 -screen 0 1024x768x24 3>"$scratch/display" >/dev/null 2>&1 &
screen=$!
read -r number <"$scratch/display"
export DISPLAY=:$number

tests=("${@:-${SUBSET[@]}}")
[[ ${1:-} != --all ]] || tests=(tests)
"$python" tools/windows/run_tests.py "$folder/winpy" "$python" --logs "$folder/logs" "${tests[@]}"
