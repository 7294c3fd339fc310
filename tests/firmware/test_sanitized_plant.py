"""Flights by a core that is compiled with the address and undefined-behaviour sanitizers: plant, filter and laws."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from quadsim.core.build import FLAGS, ROOT, include, sources, stamp, write_layout

NEAR_GROUND = {"effects.rotors": {}, "effects.ground": {"effect": True, "rotor_radius": 0.1}}
MOTION_CAPTURE = {
    **{"sensors.position.rate": 100.0, "sensors.position.noise": 0.01},
    **{"sensors.attitude.rate": 100.0, "sensors.attitude.noise": 0.26, "estimator.type": "error_state"},
}
LOST = [
    {"type": "sensor_fault", "sensor": "position", "fault": "nan", "at": 0.5, "duration": 2.0},
    {"type": "controller", "at": 0.6, "fields": {"horizon": 20}},
    {"type": "controller", "at": 1.5, "fields": {"horizon": 60}},
]
FLIGHTS: dict[str, dict[str, Any]] = {
    "paper-constrained": {"controller.solver": "core", "duration": 2.0},
    "robust": {"duration": 2.0, **NEAR_GROUND},
    "robust-lag50": {"controller.delay": 0.12, "computation.delay": 0.12, "controller.solver": "piqp", "duration": 2.0},
    "autopilot": {"duration": 1.0, **MOTION_CAPTURE},
    "landing-by-estimate": {"duration": 3.0},
    "gyro-bias": {"duration": 2.0},
    "torrente-loop8-flatness": {"duration": 1.0},
    "battery": {"duration": 1.0},
    "thrown-ball": {"duration": 2.0},
    "nonlinear": {"controller.tilt": 12.0, "controller.body_rate": 20.0, "controller.soft": {"quadratic": 0.0}},
    "inverted-start": {"controller.iterations": 3, "duration": 1.0},
    "corridor": {"duration": 7.0},
    "torrente-loop8-all": {"duration": 1.0},
    "robust-heavy": {"duration": 3.0, "controller.fallback": {"unseen": 0.3, "hover": 0.5}, "events": LOST},
}
"""Among them every effect, both integrators, the autopilot, INDI, the filter, sensor faults and obstacles that move; of
nonlinear MPC targets and rotors, lag, moves, slews, soft rows, half-spaces and drag; and a fallback that is handed
over."""
FLY = """
import ctypes, sys
import quadsim.core.library as core
core._loaded = lambda root: ctypes.CDLL(sys.argv[1])
import quadsim
for name, changes in {flights!r}.items():
    flight = quadsim.fly(quadsim.load(name).replace({{**changes, "constraints": []}}), progress=False)
    print(name, flight.log.plant.t[-1], flight.log.reason)
"""


@pytest.fixture(scope="module")
def sanitized(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """The core, and the sanitizer's own library, which has to be loaded first."""
    library = tmp_path_factory.mktemp("sanitized") / "core.so"
    flags = [flag for flag in FLAGS if flag != "-O3"]
    units = [str(file) for file in sources() if file.suffix == ".c"]
    units.append(str(write_layout(ROOT, library.parent)))
    command = ["gcc", *flags, *include(), "-O1", "-g", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    subprocess.run([*command, f'-DQUADSIM_SOURCES="{stamp()}"', *units, "-lm", "-o", str(library)], check=True)
    found = subprocess.run(["gcc", "-print-file-name=libasan.so"], check=True, capture_output=True, text=True)
    return library, Path(found.stdout.strip())


def test_flights_read_and_write_their_own_memory_alone(sanitized: tuple[Path, Path]) -> None:
    library, runtime = sanitized
    environment = {
        **os.environ,
        "PYTHONPATH": str(ROOT),
        "LD_PRELOAD": str(runtime),
        "ASAN_OPTIONS": "detect_leaks=0:allocator_may_return_null=1",
    }
    done = subprocess.run(
        [sys.executable, "-c", FLY.format(flights=FLIGHTS), str(library)],
        env=environment,
        capture_output=True,
        text=True,
        timeout=900,
    )
    assert done.returncode == 0, done.stderr[-4000:]
    flown = [line.split() for line in done.stdout.splitlines()]
    assert [name for name, *_ in flown] == [*FLIGHTS]
    assert all(float(end) > 0.9 for _, end, *_ in flown)
