#!/usr/bin/env bash
# The tests on Windows' Python under Wine: bash tools/windows_tests.sh [--all | PYTEST ARGUMENTS]
#
# Without arguments, what takes a few minutes. Wine answers over a socket some hundred times later than Linux, so all
# of it (--all, file by file) takes hours. tests/not_on_windows.toml says what is left out, and why. Where Wine cannot
# be had, one line says so, and the exit code is 0. URLAB_WINDOWS names a folder to keep the interpreter in.
set -uo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.." || exit 1

SUBSET=(
    tests/test_import.py tests/test_mujoco_releases.py tests/test_not_on_windows.py
    tests/protocol
    tests/aio/test_readiness.py tests/aio/test_busy_loops.py tests/aio/test_stream_buffer.py
    tests/server/test_debug_ops.py
)
FILE_S=900

not_run() {
    printf 'the tests on Windows were not run: %s\n' "$1"
    exit 0
}

if ! command -v wine >/dev/null || ! command -v x86_64-w64-mingw32-gcc >/dev/null; then
    [[ $(id -u) == 0 ]] && command -v apt-get >/dev/null || not_run 'wine is missing, and cannot be installed here'
    export DEBIAN_FRONTEND=noninteractive
    { apt-get update -qq && apt-get install -y -qq --no-install-recommends wine wine64 gcc-mingw-w64-x86-64; } \
        >/dev/null 2>&1 || not_run 'wine cannot be installed'
fi
[[ -d /usr/lib/python3.11 ]] || not_run 'there is no /usr/lib/python3.11, whose standard library would be used'

folder=${URLAB_WINDOWS:-}
if [[ -z $folder ]]; then
    folder=$(mktemp -d)
    trap 'rm -rf "$folder"' EXIT
fi
bash tools/windows/make_python.sh "$folder" || not_run 'the interpreter for Windows could not be made'

pytest() {
    timeout --kill-after=10 "$FILE_S" "$folder/winpy" -m pytest -q -n 0 -p no:cacheprovider -o timeout_method=thread "$@"
}

if [[ ${1:-} != --all ]]; then
    pytest "${@:-${SUBSET[@]}}"
    exit
fi
failed=()
while read -r file; do
    printf '%s: ' "$file"
    last=$(pytest "$file" 2>&1 | tee "$folder/last.log" | tail -n 1)
    status=${PIPESTATUS[0]}
    printf '%s\n' "$last"
    if ((status != 0 && status != 5)) || [[ $last == *failed* || $last == *error* ]]; then
        failed+=("$file")
        grep -E '^(E  |FAILED|ERROR)' "$folder/last.log"
    fi
done < <(git ls-files 'tests/**/test_*.py' 'tests/test_*.py')
printf '%s files failed: %s\n' "${#failed[@]}" "${failed[*]}"
((${#failed[@]} == 0))
