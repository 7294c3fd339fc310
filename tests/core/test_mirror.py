"""The mirrors of C structs and functions, against the library that is compiled from the same headers."""

from __future__ import annotations

import ctypes
from pathlib import Path

import numpy as np
import pytest

from quadsim.controller import TARGET_SIZES
from quadsim.core import mirror
from quadsim.core.build import FOLDERS, LIBRARY, ROOT, sources
from quadsim.core.headers import Declarations, read_headers
from quadsim.core.mirror import check_layout, constant, core_library, declare, make_structs, set_members, struct
from quadsim.core.structs import End, LoopKind, SampleFault
from quadsim.errors import FileError
from quadsim.mpc.guard.structs import STATUSES
from quadsim.mpc.laws.parts.nonlinear_law import WIDTH_OF_MOTION
from quadsim.mpc.laws.parts.preview import MOTION_SAMPLES
from quadsim.mpc.laws.parts.sqp import SQPStatus
from quadsim.mpc.problem.rigidbody import N_BODY
from quadsim.mpc.solvers import Method
from quadsim.vehicle import N_ROTORS

HEADERS = [file for file in sources(ROOT) if file.suffix == ".h"]
STRUCTS = tuple(read_headers(HEADERS).structs)


def changed(folder: Path, header: str, old: str, new: str) -> Declarations:
    """What copies of the headers declare after a change of one of them."""
    for file in HEADERS:
        (folder / file.name).write_text(file.read_text())
    copy = folder / header
    text = copy.read_text()
    assert text.count(old) == 1
    copy.write_text(text.replace(old, new))
    return read_headers(sorted(folder.glob("*.h")))


@pytest.mark.parametrize("name", STRUCTS)
def test_two_members_exchanged_in_a_header_are_found(name: str) -> None:
    declared = read_headers(HEADERS)
    first, *between, last = declared.structs[name]
    exchanged = declared._replace(structs={**declared.structs, name: (last, *between, first)})
    with pytest.raises(ValueError, match=rf"does not agree with the headers: {name}\b.* bytes at \d+, not \d+ at "):
        check_layout(core_library(), make_structs(exchanged))


@pytest.mark.parametrize(
    ("header", "old", "new", "problem"),
    [
        (
            "quadsim_ramp.h",
            "mass, gravity;",
            "gravity, mass;",
            r"quadsim_ramp_numbers\.gravity has 8 bytes at \d+, not 8",
        ),
        ("quadsim_plant.h", "disc, radius;", "disc, reach;", r"was compiled without quadsim_vehicle\.reach, which"),
        ("quadsim_plant.h", "double cells, ", "double ", r"quadsim_vehicle\.capacity has 8 bytes at \d+, not 8 at"),
        ("quadsim_mpc.h", "int follows_rates;", "", r"quadsim_controller\.period has 8 bytes at \d+, not 8 at"),
        ("quadsim_mpc.h", "int follows_rates;", "int follows_rates, more;", r"without quadsim_controller\.more, which"),
        (
            "quadsim_mpc.h",
            "SUBSTEPS = 2",
            "SUBSTEPS = 3",
            r"quadsim_robust\.decay_before has 64 bytes at \d+, not 96 at",
        ),
        (
            "quadsim_core.h",
            "int input, lag;",
            "signed char input, lag;",
            r"quadsim_term\.input has 4 bytes at 8, not 1 at 8",
        ),
        (
            "quadsim_guard.h",
            "} quadsim_trim;",
            "} quadsim_trim;\ntypedef struct toy {\n    int x;\n} toy;",
            r"without toy\.x, which",
        ),
    ],
)
def test_any_change_of_a_header_is_found(tmp_path: Path, header: str, old: str, new: str, problem: str) -> None:
    structs = make_structs(changed(tmp_path, header, old, new))
    with pytest.raises(ValueError, match=problem):
        check_layout(core_library(), structs)


def test_a_struct_that_the_headers_lack_is_found() -> None:
    structs = dict(make_structs(read_headers(HEADERS)))
    del structs["quadsim_push"]
    with pytest.raises(ValueError, match="was compiled with quadsim_push, which the headers do not declare"):
        check_layout(core_library(), structs)


def test_a_function_that_the_library_lacks_is_found(tmp_path: Path) -> None:
    old = "void quadsim_work_reset(quadsim_work *work);"
    declared = changed(tmp_path, "quadsim_core.h", old, old.replace("reset", "clear"))
    own_handle = ctypes.CDLL(str(ROOT / LIBRARY))  # the types of the shared one stay
    with pytest.raises(ValueError, match="lacks the function quadsim_work_clear"):
        declare(own_handle, declared, make_structs(declared))


def test_a_library_without_the_table_is_refused() -> None:
    with pytest.raises(ValueError, match="has no table of its structs"):
        check_layout(ctypes.CDLL(None), {})


def test_a_library_that_does_not_agree_is_one_clear_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mirror, "load_library", lambda: ctypes.CDLL(None))
    with pytest.raises(FileError, match=r"_core\.so: has no table of its structs; run: pip install --editable "):
        core_library.__wrapped__()


def test_a_header_that_cannot_be_mirrored_is_one_clear_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for folder in FOLDERS:
        (tmp_path / folder).mkdir(parents=True)
    monkeypatch.setattr(mirror, "ROOT", tmp_path)
    with pytest.raises(FileError, match=r"quadsim/core: the C headers are missing; run: pip install --force-reinstall"):
        mirror._declared.__wrapped__()
    header = tmp_path / FOLDERS[1] / "quadsim_wrong.h"
    header.write_text("typedef struct wrong {\n    long double x;\n} wrong;\n")
    with pytest.raises(FileError, match=r"quadsim_wrong\.h: line 2: type 'long double' is not known") as caught:
        mirror._declared.__wrapped__()
    assert caught.value.exit_status == 2


def test_a_pointer_to_a_struct_takes_that_struct_alone() -> None:
    reset = core_library().quadsim_work_reset
    work = struct("quadsim_work")()
    work.changes = 5
    with pytest.raises(ctypes.ArgumentError):
        reset(struct("quadsim_trim")())
    with pytest.raises(ctypes.ArgumentError):
        reset(ctypes.addressof(work))
    restart = core_library().quadsim_ramp_reset
    ramp = struct("quadsim_ramp")()
    numbers = struct("quadsim_ramp_numbers")()
    acting = np.arange(1.0, 5.0)
    array = (ctypes.c_double * 4)(*acting)
    for pointer in (ramp, ctypes.byref(ramp), ctypes.pointer(ramp)):
        for address in (acting.ctypes.data, array, ctypes.byref(array)):
            ramp.acting[:] = [0.0] * 4
            restart(pointer, numbers, address)
            assert list(ramp.acting) == acting.tolist()


def test_structs_within_structs_are_the_same_mirrors() -> None:
    law = struct("quadsim_nonlinear")()
    assert type(law.ramp) is struct("quadsim_ramp")
    assert type(law.world) is type(law.then) is struct("quadsim_nmpc_world")
    assert struct("quadsim_ramp") is struct("quadsim_ramp")


def test_members_take_as_many_numbers_as_they_have() -> None:
    target = struct("quadsim_geometric_target")()
    set_members(target, path=np.arange(15.0), yaw=(1, 2, 3), headed=1)
    assert [list(row) for row in target.path][4] == [12.0, 13.0, 14.0]
    assert (list(target.yaw), target.headed) == ([1.0, 2.0, 3.0], 1)
    with pytest.raises(ValueError, match="cannot reshape"):
        set_members(target, yaw=(1.0, 2.0))
    with pytest.raises(AttributeError):
        set_members(target, yawn=1.0)


# What Python names itself


def test_enumerations_are_those_of_the_headers() -> None:
    for end in End:
        assert constant(f"QUADSIM_{end.name}") == end
    for kind in LoopKind:
        assert constant(kind.name) == kind
    for fault in ("LOST", "FROZEN", "NO_NUMBER"):
        assert constant(fault) == getattr(SampleFault, fault)
    for method in Method:
        assert constant(f"QUADSIM_FOUND_{method.name}") == method
    for status in SQPStatus:
        assert constant(f"QUADSIM_NMPC_{status.name}") == status
    for i, commands in enumerate(TARGET_SIZES):
        assert constant(f"QUADSIM_GEOMETRIC_{commands.upper()}") == i
    for i, status in enumerate(STATUSES[3:], 3):
        assert constant(f"QUADSIM_{status.upper()}") == i


def test_sizes_are_those_of_the_headers() -> None:
    assert constant("QUADSIM_INPUTS") == constant("ROTORS") == N_ROTORS
    assert constant("QUADSIM_NMPC_BODY") == N_BODY
    assert constant("QUADSIM_MOTION") == WIDTH_OF_MOTION
    assert constant("QUADSIM_GEOMETRIC_SAMPLES") == MOTION_SAMPLES
