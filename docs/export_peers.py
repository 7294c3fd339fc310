"""DAQP's own C, OSQP's and TinyMPC's generated code on the problem of an exported controller and its periods."""

from __future__ import annotations

import re
import subprocess
import sys
import tarfile
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np
import osqp
import scipy.linalg
import scipy.sparse
from export_tinympc import vectors, write_tinympc
from make_numbers import ROOT
from numpy.typing import NDArray

from mpc.export.ctext import reals
from mpc.export.targets import TICK, Target
from mpc.ocp import Problem
from mpc.paper.condensed import Condensed
from quadsim.state import Array
from scenarios.export.record import Recording

SOURCES: Final = ROOT / "tests" / "firmware" / "peers"
OURS: Final = ROOT / "mpc" / "export" / "c"
FLAGS: Final = ["-O3", "-std=gnu99", "-ffp-contract=off", "-ffunction-sections", "-fdata-sections", "-w"]
PLUS: Final = ["-std=gnu++17", "-DNDEBUG", "-fno-exceptions", "-fno-rtti", "-fno-threadsafe-statics"]
CONSTRUCTORS: Final = ". = ALIGN(4); constructors = .; KEEP(*(.init_array*)) constructors_end = .;"
"""For C++: where the constructors of static objects are listed."""
ASSIGNED: Final = {"double": [], "float": ["-DPEER_FLOAT", "-fsingle-precision-constant"]}


@dataclass(frozen=True, kw_only=True)
class Condition:
    """The condensed QP of a problem: min 1/2 x'Hx + c'x, lower <= [x; G x + shift] <= upper.

    `c` (n, q) and `shift` (m, q) are linear in a period's inputs: state, reference, u(k-1) and 1.
    """

    H: Array
    G: Array
    c: Array
    shift: Array
    lower: Array
    upper: Array


def condition(problem: Problem) -> Condition:
    """The QP, its vectors by their values for one question at a time."""
    condensed, N, n, nu = Condensed(problem), problem.horizon, problem.model.n, problem.model.nu
    inputs = n + 4 * N + nu

    def vectors(question: Array) -> Array:
        reference = question[n : n + 4 * N].reshape(N, 4)
        found = condensed.vectors(question[:n], problem.objective.desired(reference), question[n + 4 * N :])
        return np.concatenate([found.c, -found.h_u])

    offset = vectors(np.zeros(inputs))
    slopes = np.array([vectors(row) - offset for row in np.eye(inputs)]).T
    maps, qp, size = np.column_stack([slopes, offset]), condensed.qp, N * nu
    shift, rows = maps[size:].copy(), problem.rows
    upper = np.concatenate([qp.x_u, np.tile(_hard(problem, rows.upper), N)])
    lower = np.concatenate([qp.x_l, np.tile(_hard(problem, rows.lower), N)])
    shift[:, -1] += upper[size:]
    return Condition(H=qp.P, G=qp.G, c=maps[:size], shift=shift, lower=lower, upper=upper)


def _hard(problem: Problem, bound: Array) -> Array:
    assert np.isinf(problem.rows.l1).all()
    return bound[0, problem.rows.input < 0]


def _header(path: Path, sizes: dict[str, int], arrays: dict[str, Array]) -> None:
    lines = [f"#define {name} {value}" for name, value in sizes.items()]
    path.write_text("\n".join([*lines, *(reals(name, values) for name, values in arrays.items())]), encoding="utf-8")


def write_problem(directory: Path, problem: Condition, recording: Recording, maps: Array) -> None:
    """What peer.c reads."""
    periods, asked = len(recording.state), maps.shape[1]
    sizes = {"PERIODS": periods, "VECTORS": len(maps), "INPUTS": asked}
    arrays = {"STATE": recording.state, "PATH": recording.path, "ACTING": recording.acting, "MAP": maps}
    _header(directory / "problem.h", sizes, arrays)


def write_daqp(directory: Path, qp: Condition, recording: Recording) -> list[Path]:
    """DAQP's data in least-distance form, and its sources from the package index."""
    R = np.linalg.cholesky(qp.H).T
    inverse = scipy.linalg.solve_triangular(R, np.eye(len(R)))
    norms = np.linalg.norm(inverse, axis=1)
    rows = qp.G @ inverse
    lengths = np.linalg.norm(rows, axis=1)
    size, count = len(R), len(R) + len(rows)
    arrays = {
        "ROOT_INVERSE": (inverse / norms[:, None])[np.triu_indices(size)],
        "ROWS": rows / lengths[:, None],
        "SCALING": np.concatenate([1.0 / norms, 1.0 / lengths]),
        "LOWER": qp.lower,
        "UPPER": qp.upper,
    }
    _header(directory / "daqp_data.h", {"SIZE": size, "COUNT": count, "BOXED": size}, arrays)
    free = -scipy.linalg.cho_solve((R, False), qp.c)
    write_problem(directory, qp, recording, np.vstack([free, qp.G @ free + qp.shift]))
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", "daqp", "daqp"]
    subprocess.run([*command, "--dest", str(directory)], check=True)
    (archive,) = directory.glob("daqp-*.tar.gz")
    with tarfile.open(archive) as packed:
        packed.extractall(directory, filter="data")
    source = directory / archive.name.removesuffix(".tar.gz") / "csrc"
    return [source / "include", *(source / "src" / f"{name}.c" for name in ("daqp", "auxiliary", "factorization"))]


def write_osqp(directory: Path, qp: Condition, recording: Recording, precision: str) -> list[Path]:
    """OSQP's generated code."""
    A = scipy.sparse.csc_matrix(np.vstack([np.eye(len(qp.H)), qp.G]))
    solver, H = osqp.OSQP(), scipy.sparse.csc_matrix(np.triu(qp.H))
    solver.setup(H, np.zeros(len(qp.H)), A, qp.lower, qp.upper, verbose=False, eps_abs=1e-4, eps_rel=1e-4)
    code = directory / "code"
    solver.codegen(str(code), parameters="vectors", use_float=precision == "float", force_rewrite=True)
    _header(
        directory / "osqp_data.h",
        {"SIZE": len(qp.H), "COUNT": len(qp.lower)},
        {"LOWER": qp.lower, "UPPER": qp.upper},
    )
    write_problem(directory, qp, recording, np.vstack([qp.c, qp.shift]))
    return [code, code / "inc" / "public", code / "inc" / "private", code / "workspace.c", *(code / "src").glob("*.c")]


TOOLS: Final = ("size", "arm-none-eabi-size")
"""The programs that measure object files: of this machine's, and of a board's."""


class Measured(NamedTuple):
    """What a program answered to the recorded periods, what it took, and its size."""

    status: NDArray[np.int64]  # (K,) of `quadsim_mpc.h`; of a peer 1 without an optimum
    changes: NDArray[np.int64]  # (K,) of the active set, or iterations
    command: Array  # (K, 4) [rad/s]
    ticks: NDArray[np.int64]  # (K,) [instructions], of a POSIX system [ns]
    flash: int  # bytes of code and constants
    memory: int  # bytes that change, the heap included
    heap: int = 0  # bytes


def answered(text: str, target: Target, flash: int = 0, memory: int = 0) -> Measured:
    """Read what main.c or peer.c has printed."""
    rows = [line.split() for line in text.splitlines() if len(line.split()) == 8]
    whole = [[int(row[i], 16) for row in rows] for i in (1, 2, 7)]
    kind = ">f8" if len(rows[0][3]) == 16 else ">f4"
    bits = bytes.fromhex("".join(word for row in rows for word in row[3:7]))
    status, changes, ticks = (np.array(column) for column in whole)
    command = np.frombuffer(bits, kind).reshape(-1, 4).astype(float)
    return Measured(status, changes, command, ticks * (TICK if target.board else 1), flash, memory)


def unwrapped(found: Measured) -> Measured:
    """With the turns of the board's clock, which wraps after 2^24 ticks, in steps of so many iterations that it did."""
    turn = 2**24 * TICK
    each = float(np.median(found.ticks / np.maximum(found.changes, 1)))
    turns = np.maximum(np.round((found.changes * each - found.ticks) / turn), 0).astype(np.int64)
    return found._replace(ticks=found.ticks + turn * turns)


def size(tool: str, files: Iterable[Path]) -> tuple[int, int]:
    """Bytes of object files: code and constants, and what changes."""
    lines = subprocess.run([tool, *files], capture_output=True, text=True, check=True).stdout.splitlines()[1:]
    text, data, zeroed = np.array([[int(word) for word in line.split()[:3]] for line in lines]).sum(axis=0)
    return int(text + data), int(data + zeroed)


def run_peer(
    name: str, directory: Path, problem: Problem, recording: Recording, target: Target, precision: str
) -> Measured:
    """Compile a peer for a target and let it answer the recorded periods."""
    qp = condition(problem)
    own: list[str] = []
    if name == "daqp":
        parts = write_daqp(directory, qp, recording)
        own = ["-DDAQP_NO_SOFT_WEIGHTS", *(["-DDAQP_SINGLE_PRECISION"] if precision == "float" else [])]
    elif name == "osqp":
        parts = write_osqp(directory, qp, recording, precision)
    else:
        assert (bool(target.board), precision) == (True, "double")
        write_problem(directory, qp, recording, vectors(problem, recording))
        parts = write_tinympc(directory, problem, recording, SOURCES)
    folders = [*(part for part in parts if part.is_dir()), directory, SOURCES, OURS]
    flags = [*target.machine.split(), *FLAGS, *ASSIGNED[precision], *own, *(f"-I{folder}" for folder in folders)]
    theirs = [part for part in parts if not part.is_dir()] + list(SOURCES.glob(f"peer_{name}.c*"))
    objects = []
    for source in [*theirs, SOURCES / "peer.c", OURS / target.sources[0]]:
        objects.append(directory / f"{source.stem}.o")
        plus = source.suffix == ".cpp"
        compiler = target.compiler.replace("gcc", "g++") if plus else target.compiler
        subprocess.run([compiler, *flags, *(PLUS if plus else []), "-c", source, "-o", objects[-1]], check=True)
    script = (OURS / "mps2.ld").read_text(encoding="utf-8").replace("*(.rodata*)", f"*(.rodata*) {CONSTRUCTORS}")
    (directory / "mps2.ld").write_text(script, encoding="utf-8")
    image, link = directory / "peer.elf", target.link.replace("mps2.ld", str(directory / "mps2.ld")).split()
    link += ["--specs=nosys.specs"] if target.board else []
    subprocess.run([target.compiler, *flags, "-o", image, *objects, *link, "-Wl,--gc-sections", "-lm"], check=True)
    command = [*target.emulation, "-serial", "none", "-kernel", image] if target.board else [image]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    text = done.stdout + done.stderr
    flash, memory = size(TOOLS[bool(target.board)], objects[: len(theirs)])
    heap = max((int(word, 16) for word in re.findall(r"^heap (\w+)$", text, re.MULTILINE)), default=0)
    found = answered(text, target, flash, memory + heap)._replace(heap=heap)
    return unwrapped(found) if name == "osqp" and target.board else found
