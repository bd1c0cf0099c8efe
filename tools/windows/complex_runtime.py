"""Write shim.c and shim.def: a math runtime with the complex functions that Wine's lacks, and the rest forwarded to it.

complex_runtime.py FOLDER DLL, where DLL is Microsoft's own, whose list of exported names is taken over.
"""

import pathlib
import re
import subprocess
import sys

FOLDER, DLL = map(pathlib.Path, sys.argv[1:])
FUNCTIONS = [
    "cabs",
    "cacos",
    "cacosh",
    "carg",
    "casin",
    "casinh",
    "catan",
    "catanh",
    "ccos",
    "ccosh",
    "cexp",
    "cimag",
    "clog",
    "clog10",
    "conj",
    "cpow",
    "cproj",
    "creal",
    "csin",
    "csinh",
    "csqrt",
    "ctan",
    "ctanh",
    "norm",
]
REAL = {"cabs", "carg", "cimag", "creal", "norm"}
PRELUDE = """#include <complex.h>
#include <math.h>
typedef struct { double re, im; } D;
typedef struct { float re, im; } F;
static double complex d(D x) { return x.re + I * x.im; }
static D to_D(double complex z) { D r = {creal(z), cimag(z)}; return r; }
static float complex f(F x) { return x.re + I * x.im; }
static F to_F(float complex z) { F r = {crealf(z), cimagf(z)}; return r; }
"""
BUILDERS = {
    "_Cbuild": "D my__Cbuild(double a, double b) { D r = {a, b}; return r; }",
    "_FCbuild": "F my__FCbuild(float a, float b) { F r = {a, b}; return r; }",
    "_Cmulcc": "D my__Cmulcc(D a, D b) { return to_D(d(a) * d(b)); }",
    "_FCmulcc": "F my__FCmulcc(F a, F b) { return to_F(f(a) * f(b)); }",
    "_Cmulcr": "D my__Cmulcr(D a, double b) { D r = {a.re * b, a.im * b}; return r; }",
    "_FCmulcr": "F my__FCmulcr(F a, float b) { F r = {a.re * b, a.im * b}; return r; }",
}

dump = subprocess.run(["x86_64-w64-mingw32-objdump", "-p", DLL], capture_output=True, text=True, check=True).stdout  # noqa: S603, S607
names = re.findall(r"^\s*\[\s*\d+\].*\s(\w+)$", dump.split("[Ordinal/Name Pointer] Table", 1)[1], re.MULTILINE)
code, exports = [PRELUDE], []
own = {name: line for name, line in BUILDERS.items() if name in names}
for function in FUNCTIONS:
    for suffix, struct, to_complex in (("", "D", "d"), ("l", "D", "d"), ("f", "F", "f")):
        name, base = function + suffix, function + ("f" if suffix == "f" else "")
        if name not in names:
            continue
        scalar = "float" if suffix == "f" else "double"
        match function:
            case "norm":
                value = "x.re * x.re + x.im * x.im"
            case "clog10":
                value = f"to_{struct}(clog{base[6:]}({to_complex}(x)) / 2.302585092994045684)"
            case "cpow":
                value = f"to_{struct}({base}({to_complex}(x), {to_complex}(y)))"
            case _:
                value = f"{base}({to_complex}(x))" if function in REAL else f"to_{struct}({base}({to_complex}(x)))"
        parameters = f"{struct} x, {struct} y" if function == "cpow" else f"{struct} x"
        result = scalar if function in REAL else struct
        own[name] = f"{result} my_{name}({parameters}) {{ return {value}; }}"
code += own.values()
exports = [f"  {name} = " + (f"my_{name}" if name in own else f"ucrtbase.{name}") for name in names]
(FOLDER / "shim.c").write_text("\n".join(code) + "\n")
(FOLDER / "shim.def").write_text("LIBRARY xpi-ms-win-crt-math-l1-1-0.dll\nEXPORTS\n" + "\n".join(exports) + "\n")
