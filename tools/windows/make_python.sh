#!/usr/bin/env bash
# A CPython for Windows under Wine, with this project in it: make_python.sh FOLDER [SECONDS]
#
# FOLDER gets the interpreter (python311.dll and extension modules as published for Windows, the standard library of
# this machine's Python 3.11, a launcher of ten lines), the Windows wheels of the test dependencies, and the project's
# wheel. SECONDS are for everything, where there is no more time than that. Run programs with FOLDER/winpy:
#
#     FOLDER/winpy -m urlab_client --version
#     FOLDER/winpy -m pytest tests/protocol
#
# What it shows: Proactor loop, Windows' sockets, processes, named events, file mapping and paths, as Wine implements
# them. What it does not: times, OpenGL, the console's Ctrl-C, and whatever Wine does differently from Windows. Needs
# wine, x86_64-w64-mingw32-gcc and /usr/lib/python3.11, all of which Debian 12 has.
set -euo pipefail
until_s=${2:-1000000}
target=$(mkdir -p "$1" && cd "$1" && pwd)
here=$(cd "$(dirname "${BASH_SOURCE[0]}")" && pwd)
project=$(cd "$here/../.." && pwd)
site=$target/py/Lib/site-packages
export WINEDLLOVERRIDES='winedbg.exe,winemenubuilder.exe,mscoree,mshtml=d'

# within SECONDS WHAT COMMAND...: say what is done, do it, and end with a line where it fails or takes longer.
within() {
    local limit=$1 what=$2 left=$((until_s - SECONDS)) status=0
    shift 2
    limit=$((left < 0 ? 0 : limit < left ? limit : left))
    if ((limit > 0)); then
        printf 'Windows: %s, at most %s s\n' "$what" "$limit"
        timeout --kill-after=5 "$limit" "$@" </dev/null || status=$?
    else
        status=124
    fi
    case $status in
        0) return ;;
        124 | 137) printf 'Windows: %s: given up after %s s\n' "$what" "$limit" ;;
        *) printf 'Windows: %s: exit code %s\n' "$what" "$status" ;;
    esac
    exit 1
}

pip=(python3 -m pip --disable-pip-version-check -qq --timeout 20 --retries 2)
windows_wheels=(download --platform win_amd64 --python-version 3.11 --implementation cp --only-binary=:all:)

# What Wine leaves running keeps the output of who started it open: none of ours may be among it.
kill_wine() {
    grep -lzsx "WINEPREFIX=$target/prefix" /proc/[0-9]*/environ | cut -d / -f 3 | xargs -r kill -9 || true
}

work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

if [[ ! -e $target/py/bcryptprimitives.dll ]]; then
    # Panda3D's wheel for Windows carries CPython's own DLL and extension modules, to put them beside frozen programs.
    within 120 'downloading the interpreter' "${pip[@]}" "${windows_wheels[@]}" -d "$work" --no-deps panda3d
    python3 -m zipfile -e "$work"/panda3d-*.whl "$work/x"
    rm -rf "$target/py" && mkdir -p "$target/py/DLLs"
    cp "$work"/x/deploy_libs/*.pyd "$work"/x/deploy_libs/*.dll "$target/py/DLLs/"
    rm -f "$target"/py/DLLs/api-ms* "$target"/py/DLLs/VCRUNTIME140.dll
    mv "$target/py/DLLs/python311.dll" "$target/py/"
    cp -r /usr/lib/python3.11 "$target/py/Lib"
    rm -rf "$target"/py/Lib/{lib-dynload,dist-packages,test} "$target"/py/Lib/config-*
    # Debian's 3.11.2 has it without the decorator that later releases of 3.11, as this interpreter, count on.
    metadata=$target/py/Lib/importlib/metadata/__init__.py
    grep -B 1 'def invalidate_caches(cls)' "$metadata" | grep -q classmethod ||
        sed -i 's/^    def invalidate_caches(cls):/    @classmethod\n&/' "$metadata"
    mkdir -p "$site"
    x86_64-w64-mingw32-gcc -municode -O2 -o "$target/py/python.exe" "$here/launcher.c"
    # Wine 8 lacks the C runtime's complex functions, which NumPy imports: a DLL of our own has them.
    python3 "$here/complex_runtime.py" "$work" "$work/x/deploy_libs/api-ms-win-crt-math-l1-1-0.dll"
    x86_64-w64-mingw32-gcc -shared -O2 -w -fno-builtin -static-libgcc -o "$target/py/xpi-ms-win-crt-math-l1-1-0.dll" \
        "$work/shim.c" "$work/shim.def"
    # Modules for any release of Python 3 ask for python3.dll, which hands all on to python311.dll.
    {
        printf 'EXPORTS\n'
        x86_64-w64-mingw32-objdump -p "$target/py/python311.dll" | sed -n '/Name Pointer\] Table/,/^$/p' |
            grep -oE '\b_?Py\w+$' | sort -u | sed 's/.*/& = python311.&/'
    } >"$work/python3.def"
    x86_64-w64-mingw32-gcc -shared -static-libgcc -o "$target/py/python3.dll" "$work/python3.def"
    x86_64-w64-mingw32-gcc -shared -O2 -o "$target/py/bcryptprimitives.dll" "$here/random_bytes.c" -ladvapi32
fi

# Under Wine the interpreter starts only where its output is a pipe. Wine's own .NET and browser, which it would ask for
# on a screen, and entries in menus are not needed.
cat >"$target/winpy" <<EOF
#!/usr/bin/env bash
export WINEPREFIX=\${WINEPREFIX:-$target/prefix} WINEDEBUG=\${WINEDEBUG:--all} WINEARCH=win64 PYTHONDONTWRITEBYTECODE=1
export WINEDLLOVERRIDES='$WINEDLLOVERRIDES'
[[ ! -p /dev/stdout ]] || exec wine "$target/py/python.exe" "\$@" 2>&1 </dev/null
set -o pipefail
wine "$target/py/python.exe" "\$@" 2>&1 </dev/null | cat
EOF
chmod +x "$target/winpy"

# What pyproject.toml asks for, but for a browser's driver, whose dependencies have no wheels here.
mapfile -t packages < <(
    python3 - "$project/pyproject.toml" <<'EOF'
import sys
import tomllib

with open(sys.argv[1], "rb") as file:
    project = tomllib.load(file)["project"]
# pip asks Linux what Windows needs: the last ones are dependencies of dependencies there alone, and pip itself.
for requirement in [*project["dependencies"], *project["optional-dependencies"]["test"], "cffi", "colorama", "pywin32", "pip"]:
    if not requirement.startswith(("selenium", "uvloop")):
        print(requirement)
EOF
)
if [[ $(cat "$site/.packages" 2>/dev/null) != "${packages[*]}" ]]; then
    within 180 'downloading the dependencies' "${pip[@]}" "${windows_wheels[@]}" -d "$work/wheels" "${packages[@]}"
    for wheel in "$work"/wheels/*.whl; do
        python3 -m zipfile -e "$wheel" "$site/"
    done
    mkdir -p "$target/py/Scripts" && cp "$target/py/bcryptprimitives.dll" "$target/py/Scripts/"
    find "$site" -path '*.data/scripts/*.exe' -exec mv {} "$target/py/Scripts/" \;
    python3 - "$site" <<'EOF'
import pathlib
import sys

for path in pathlib.Path(sys.argv[1]).rglob("*"):
    if path.suffix.lower() in {".pyd", ".dll"}:
        old = path.read_bytes()
        new = old.replace(b"api-ms-win-crt-math-l1-1-0.dll", b"xpi-ms-win-crt-math-l1-1-0.dll")
        if new != old:
            path.write_bytes(new)
EOF
    printf '%s' "${packages[*]}" >"$site/.packages"
fi
within 120 "building the project's wheel" "${pip[@]}" wheel --no-deps -w "$work/built" "$project"
rm -rf "$site"/{urlab_client,pytest_urlab,urlab_client-*.dist-info}
python3 -m zipfile -e "$work"/built/*.whl "$site/"

trap 'kill_wine; rm -rf "$work"' EXIT
if [[ ! -e $target/prefix/.made ]]; then
    rm -rf "$target/prefix"
    within 120 'setting up Wine' env -u DISPLAY WINEPREFIX="$target/prefix" WINEDEBUG=-all WINEARCH=win64 \
        bash -c 'exec wineboot -i >/dev/null 2>&1'
    touch "$target/prefix/.made"
fi
rm -f "$target/version"
within 60 'starting the interpreter' env WINEPREFIX="$target/prefix" bash -c 'exec "$0" "$@" > >(cat >/dev/null)' \
    "$target/winpy" -c 'import sys, numpy, zmq, mujoco
with open(sys.argv[1], "w") as file:
    print(sys.version, numpy.__version__, zmq.__version__, mujoco.__version__, file=file)' "Z:$target/version"
cat "$target/version"
trap 'rm -rf "$work"' EXIT
