"""The problem of an exported controller as TinyMPC takes it, its generated code, and its own problem's exact optimum.

TinyMPC minimises sum 1/2 x'Qx + 1/2 u'Ru about targets, Q and R diagonal, over boxes, and its last state has the weight
of its own Riccati equation.  Its state here is [x(k); u(k-1) - u_bar], its input u(k) - u(k-1), so that all bounds are
boxes.  It adds its step size rho to all weights, which is taken off them here, and once more for the last state.
"""

from __future__ import annotations

import subprocess
import sys
import tarfile
from pathlib import Path
from typing import Final, NamedTuple

import daqp
import numpy as np

from mpc.export.ctext import reals, small_integers
from mpc.model import LinearModel
from mpc.ocp import Problem
from mpc.paper.prediction import prediction
from quadsim.state import REFERENCE_STATES, Array
from scenarios.export.record import Recording

VERSION: Final = "0.0.8"
NO_BOUND: Final = 1e17
"""TinyMPC's infinity."""
RHO, TOLERANCE, ITERATIONS = 4.0, 1e-3, 1000
"""Tolerance and iterations are TinyMPC's defaults; rho and the units below took the fewest iterations of all tried."""
WEIGHT: Final = "weight.txt"
ANGLE, OTHER, STEP = 0.03, 150.0, 10.0
"""Units of states with bounds of their own [rad], of all other states and speeds, and of inputs [rad/s]."""


class Augmented(NamedTuple):
    """TinyMPC's problem, in SI units."""

    A: Array  # (n, n)
    B: Array  # (n, nu)
    Q: Array  # (n,) diagonal; inputs, which are steps, have no weight
    x_min: Array  # (n, N + 1)
    x_max: Array
    u_min: Array  # (nu, N)
    u_max: Array
    units: Array  # (n,) of states
    first: Array  # (K, n) state at each period
    targets: Array  # (K, N, n)


def augmented(problem: Problem, recording: Recording) -> Augmented:
    """The problem and its recorded periods with the last input as a state."""
    model, objective, bounds, N = problem.model, problem.objective, problem.bounds, problem.horizon
    nx, nu, (Q, _) = model.n, model.nu, objective.weights
    assert bounds is not None
    assert (objective.Q_d, objective.P) == (None, None)
    weights = np.concatenate([np.diag(Q), np.diag(objective.Q_u)])
    assert np.count_nonzero(Q) + np.count_nonzero(objective.Q_u) == np.count_nonzero(weights)
    held = np.argmax(bounds.C_c, axis=1)
    assert np.array_equal(bounds.C_c, np.eye(nx)[held])
    x_max = np.full((nx + nu, N + 1), np.inf)
    x_min, units = -x_max, np.full(nx + nu, OTHER)
    for limit, outputs, speeds in ((x_min, bounds.y_min, bounds.u_min), (x_max, bounds.y_max, bounds.u_max)):
        limit[held, 1:], limit[nx:, 1:] = outputs[:, None], (speeds - model.u_bar)[:, None]
    units[held] = ANGLE
    targets = np.zeros((len(recording.state), N, nx + nu))
    for k, target in enumerate(targets):
        target[:, REFERENCE_STATES] = recording.path[k : k + N]
    return Augmented(
        A=np.block([[model.A, model.B], [np.zeros((nu, nx)), np.eye(nu)]]),
        B=np.vstack([model.B, np.eye(nu)]),
        Q=weights,
        x_min=x_min,
        x_max=x_max,
        u_min=np.tile(bounds.delta_min[:, None], N),
        u_max=np.tile(bounds.delta_max[:, None], N),
        units=units,
        first=np.hstack([recording.state, recording.acting - model.u_bar]),
        targets=targets,
    )


def write_tinympc(directory: Path, problem: Problem, recording: Recording, sources: Path) -> list[Path]:
    """TinyMPC's generated code, and beside it what its peer.cpp reads and `own_optima` takes."""
    given, N = augmented(problem, recording), problem.horizon
    n, nu = given.B.shape
    units = given.units[:, None]
    text = [f"#define {name} {value}" for name, value in (("NX", n), ("NU", nu), ("NODES", N + 1))]
    arrays = {
        "A": given.A * given.units / units,
        "B": given.B * STEP / units,
        "STATE_WEIGHTS": given.Q * given.units**2 - RHO,
        "INPUT_WEIGHTS": np.full(nu, -RHO),
        "X_MIN": (given.x_min / units).clip(-NO_BOUND, NO_BOUND),
        "X_MAX": (given.x_max / units).clip(-NO_BOUND, NO_BOUND),
        "U_MIN": given.u_min / STEP,
        "U_MAX": given.u_max / STEP,
        "SETTINGS": np.array([RHO, TOLERANCE, ITERATIONS]),
    }
    lines = [*text, *(reals(name, values.T) for name, values in arrays.items())]
    (directory / "tinympc_problem.h").write_text("\n".join(lines), encoding="utf-8")
    lines = [*text, reals("STEP", [STEP]), small_integers("TARGETS", REFERENCE_STATES)]
    (directory / "tinympc_data.h").write_text("\n".join(lines), encoding="utf-8")
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--no-deps", "--no-binary", "tinympc"]
    subprocess.run([*command, f"tinympc=={VERSION}", "--dest", str(directory)], check=True)
    (archive,) = directory.glob("tinympc-*.tar.gz")
    with tarfile.open(archive) as packed:
        packed.extractall(directory, filter="data")
    # What its Python package copies beside the generated file, which the newer sources in the archive do not compile.
    theirs = directory / f"tinympc-{VERSION}" / "src" / "tinympc" / "codegen" / "codegen_src"
    tiny, code = theirs / "tinympc", directory / "code"
    folders = [sources / "tinympc", theirs / "include" / "Eigen", theirs, tiny]
    generator = [sources / "tinympc" / "generate.cpp", *(tiny / f"{part}.cpp" for part in ("tiny_api", "codegen"))]
    generator += [tiny / "admm.cpp", tiny / "rho_benchmark.cpp"]
    flags = ["-std=gnu++17", "-DNDEBUG", "-w", *(f"-I{folder}" for folder in (*folders[1:], directory, sources))]
    subprocess.run(["g++", *flags, *generator, "-o", directory / "generate"], check=True)
    with (directory / WEIGHT).open("w", encoding="utf-8") as printed:
        subprocess.run([directory / "generate", code], stdout=printed, check=True)
    return [*folders, code, code / "src" / "tiny_data.cpp", tiny / "admm.cpp", tiny / "rho_benchmark.cpp"]


def vectors(problem: Problem, recording: Recording) -> Array:
    """First state in TinyMPC's units, targets likewise, and u(k-1), by state, reference, u(k-1) and 1."""
    nx, nu, N, units = problem.model.n, problem.model.nu, problem.horizon, augmented(problem, recording).units
    scale = 1.0 / np.concatenate([units[:nx], np.tile(units[list(REFERENCE_STATES)], N), units[nx:]])
    maps = np.column_stack([np.diag(scale), np.zeros(scale.size)])
    maps[-nu:, -1] = -problem.model.u_bar / units[nx:]
    return np.vstack([maps[:nx], maps[-nu:], maps[nx:-nu], np.eye(scale.size + 1)[-1 - nu : -1]])


def own_optima(problem: Problem, recording: Recording, directory: Path) -> Array:
    """(K, 4) first commands that are optimal to TinyMPC's own problem, from where `write_tinympc` wrote."""
    given, N = augmented(problem, recording), problem.horizon
    n, nu = given.B.shape
    P = np.loadtxt(directory / WEIGHT).reshape(n, n) / given.units[:, None] / given.units
    maps = prediction(LinearModel(A=given.A, B=given.B, u_bar=np.zeros(nu), period=problem.model.period), N)
    Psi, Phi = maps.Psi.reshape(N, n, -1), maps.Phi.reshape(N, n, n)
    weights = np.tile(np.diag(given.Q), (N, 1, 1))
    pulls = weights.copy()
    # Its Riccati equation has a rho too many, which its proximal term takes off the weight but not off the target's.
    weights[-1], pulls[-1] = P - np.diag(RHO / given.units**2), P
    H = np.einsum("iab,iac,icd->bd", Psi, weights, Psi, optimize=True)
    of_state = np.einsum("iab,iac,icd->bd", Psi, weights, Phi, optimize=True)
    of_targets = np.einsum("iab,iac->bic", Psi, pulls)
    held = np.isfinite(given.x_max[:, 1])
    rows, shift = Psi[:, held].reshape(-1, N * nu), Phi[:, held].reshape(-1, n)
    lower, upper = (limit[held, 1:].T.ravel() for limit in (given.x_min, given.x_max))
    optima = np.empty((len(given.first), nu))
    for k, (first, targets) in enumerate(zip(given.first, given.targets, strict=True)):
        c, moved = of_state @ first - np.einsum("bic,ic->b", of_targets, targets), shift @ first
        above = np.concatenate([given.u_max.T.ravel(), upper - moved])
        below = np.concatenate([given.u_min.T.ravel(), lower - moved])
        steps, _, flag, _ = daqp.solve(0.5 * (H + H.T), c, rows, above, below, np.zeros(above.size, np.int32))
        assert flag == 1, f"no optimum of TinyMPC's problem in period {k}"
        optima[k] = recording.acting[k] + steps[:nu]
    return optima
