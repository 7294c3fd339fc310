"""What is read of C headers, and what is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from quadsim.core.build import ROOT, sources
from quadsim.core.headers import Declarations, HeaderError, Variable, read_headers

HEADER = """/* A comment; with struct toy { int x; } in it,
 * over two lines. */
#ifndef TOY_H
#define TOY_H

#include <stdint.h>

#include "basis.h"

#ifdef __cplusplus
extern "C" {
#endif

#ifdef TOY_FLOAT
typedef float toy_real;
#define toy_start \\
    toy_start_float
#else
typedef double toy_real;
#endif

enum { NONE, FIRST = 4, SECOND, SIZE = 2 * BASIS + 1 };

enum toy_state { TOY_IDLE /* at rest */, TOY_BUSY, };

static inline int twice(int x)
{
    if (x) {
        return 2 * x;
    }
    return 0;
}

static const toy_real HALF[2] = {0.5, 0.25};

typedef struct toy {
    const toy_basis *basis, *other;
    toy_basis inside, several[2];
    void (*step)(const void *model, void *data); /* called */
    unsigned char byte;
    int count, room;
    toy_real matrix[SIZE][BASIS * 2], x, y[3];
} toy;

toy_real toy_start(toy *t, const toy_real state[12], enum toy_state state_now,
                   enum toy_state *next);
const char *toy_name(void);

#ifdef __cplusplus
}
#endif

#endif
"""
BASIS = """#define BASIS_KNOWN
enum { BASIS = 3 };
typedef struct toy_basis {
    int64_t when;
} toy_basis;
"""


def read(folder: Path, **files: str) -> Declarations:
    for name, text in files.items():
        (folder / f"{name}.h").write_text(text)
    return read_headers(sorted(folder.glob("*.h")))


def test_enumerators_structs_and_functions_are_read(tmp_path: Path) -> None:
    declared = read(tmp_path, a_toy=HEADER, basis=BASIS)
    assert declared.constants == {
        **{"BASIS": 3, "NONE": 0, "FIRST": 4, "SECOND": 5, "SIZE": 7, "TOY_IDLE": 0, "TOY_BUSY": 1},
    }
    assert declared.structs["toy_basis"] == (Variable("when", "int64_t", False, ()),)
    assert declared.structs["toy"] == (
        Variable("basis", "toy_basis", True, ()),
        Variable("other", "toy_basis", True, ()),
        Variable("inside", "toy_basis", False, ()),
        Variable("several", "toy_basis", False, (2,)),
        Variable("step", "void", True, ()),
        Variable("byte", "unsigned char", False, ()),
        Variable("count", "int", False, ()),
        Variable("room", "int", False, ()),
        Variable("matrix", "double", False, (7, 6)),
        Variable("x", "double", False, ()),
        Variable("y", "double", False, (3,)),
    )
    start = declared.functions["toy_start"]
    assert start.returned == Variable("", "double", False, ())
    assert start.parameters == (
        Variable("t", "toy", True, ()),
        Variable("state", "double", True, ()),
        Variable("state_now", "enum", False, ()),
        Variable("next", "enum", True, ()),
    )
    assert declared.functions["toy_name"].parameters == ()
    assert declared.functions["toy_name"].returned == Variable("", "char", True, ())
    assert list(declared.functions) == ["toy_start", "toy_name"]
    assert declared.headers == ("basis.h", "a_toy.h")


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ("typedef union u { int a; } u;", 1, "not known here"),
        ("typedef struct s {\n    int a;\n    union { int b; } c;\n} s;", 1, "not known here"),
        ("typedef struct s {\n    int a;\n    unsigned flag : 1;\n} s;", 3, "'unsigned flag : 1' is not a member"),
        ("typedef struct s {\n    double a,\n        *b[3];\n} s;", 2, r"'\*b\[3\]' is not a member"),
        ("typedef struct s {\n    size_t n;\n} s;", 2, "type 'size_t' is not known"),
        ("typedef struct s {\n    struct other o;\n} s;", 2, "type 'struct other' is not known"),
        ("typedef struct s {\n\n    double a[MOST];\n} s;", 3, "'MOST' is not a sum of products"),
        ("typedef struct s {\n    double a[2 << 1];\n} s;", 2, "'2 << 1' is not a sum of products"),
        ("typedef struct s {\n    volatile int a;\n} s;", 2, "type 'volatile int' is not known"),
        ("typedef struct s {\n    int a;\n} t;", 1, "struct s must have one name, not also t"),
        ("typedef struct s {\n    int a;\n} s;\ntypedef struct s {\n    int a;\n} s;", 4, "struct s is declared twice"),
        ("enum { A = 1 };\nenum { A = 2 };", 2, "A is 2 here, and 1 elsewhere"),
        ("typedef float real;\n\ntypedef double real;", 3, "real is double here, and another type elsewhere"),
        ("int f(int n,\n      ...);", 1, r"'\.\.\.' is not a parameter"),
        ("typedef struct s {\n    int a;\n} s;\nint f(s by_value);", 4, "pass its address"),
        ("int f(void);\nint f(void);", 2, "f is declared twice"),
        ("extern int counter;", 1, "'extern int counter;' is not known here"),
        ("#if SIZE > 3\nenum { A };\n#endif", 2, "a declaration under #if"),
        ('#include "absent.h"', 1, "absent.h is not among"),
        ("#warning now", 1, "#warning is not known"),
        ("#", 1, "# is not known"),
        ("#ifdef ONE\n#endif\n#else", 3, "#else without #if"),
        ("/* one\n * two */ int x;", 2, "'int x;' is not known here"),
    ],
)
def test_anything_else_is_refused_with_its_line(tmp_path: Path, text: str, line: int, problem: str) -> None:
    with pytest.raises(HeaderError, match=rf"wrong\.h: line {line}: .*{problem}"):
        read(tmp_path, wrong=text + "\n")


def test_all_of_quadsim_s_headers_are_read() -> None:
    declared = read_headers(file for file in sources(ROOT) if file.suffix == ".h")
    code = "\n".join(file.read_text() for file in sources(ROOT) if file.suffix == ".h")
    assert len(declared.structs) == code.count("typedef struct ") > 30
