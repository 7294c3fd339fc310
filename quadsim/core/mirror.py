"""Python's mirrors of quadsim's C: structs and functions as its headers declare them, which are the one declaration.

A mirror is made of a header's text, and each member's offset and size is compared with those that the compiler put into
the library, before the first function is called.
"""

from __future__ import annotations

import ctypes
from collections.abc import Mapping
from functools import cache
from typing import Any, Final, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from quadsim.core.build import FOLDERS, LIBRARY, ROOT, sources
from quadsim.core.headers import ENUM, Declarations, Function, HeaderError, Variable, read_headers
from quadsim.core.library import load_library, remedy
from quadsim.errors import FileError

Struct: TypeAlias = ctypes.Structure
"""A mirror, to a type checker, for which its members are `Any`: only the headers know them."""

_KINDS: Final[Mapping[str, Any]] = {
    "int": ctypes.c_int,
    "long": ctypes.c_long,
    "float": ctypes.c_float,
    "double": ctypes.c_double,
    "char": ctypes.c_char,
    "signed char": ctypes.c_byte,
    "unsigned char": ctypes.c_ubyte,
    "int64_t": ctypes.c_int64,
    "uint8_t": ctypes.c_uint8,
    ENUM: ctypes.c_int,
}
"""Types of `quadsim.core.headers.NUMBERS`."""


class _Place(ctypes.Structure):
    """An entry of `quadsim_layout`; see `quadsim.core.headers.layout_source`."""

    _fields_ = (("name", ctypes.c_char_p), ("offset", ctypes.c_size_t), ("size", ctypes.c_size_t))


def struct(name: str) -> type[Struct]:
    """Return the mirror of a struct, e.g. `quadsim_work`: the same class in each call.

    Pointers are `ctypes.c_void_p`, whatever they point to.

    Raises:
        FileError: the headers are missing, or have something that cannot be mirrored.
    """
    return _structs()[name]


def constant(name: str) -> int:
    """Return an enumerator of the headers; raises as `struct`."""
    return _declared().constants[name]


@cache
def core_library() -> ctypes.CDLL:
    """Return the library, with the types of all functions of the headers.

    A pointer to a struct takes such a struct, `byref` of one, an array of them, or None; any other pointer an address,
    `byref` of anything, or None.

    Raises:
        FileError: the library cannot be compiled or loaded, or does not agree with the headers.
    """
    library = load_library()
    try:
        check_layout(library, _structs())
        declare(library, _declared(), _structs())
    except ValueError as error:
        raise FileError(ROOT / LIBRARY, f"{error}; {remedy(ROOT)}") from error
    return library


def make_structs(declared: Declarations) -> dict[str, type[Struct]]:
    """Return the mirrors of all structs that headers declare."""
    structs: dict[str, type[Struct]] = {}
    for name, members in declared.structs.items():
        fields = [(member.name, _kind_of_member(member, structs)) for member in members]
        structs[name] = type(name, (Struct,), {"_fields_": fields, "__module__": __name__})
    return structs


def check_layout(library: ctypes.CDLL, structs: Mapping[str, type[Struct]]) -> None:
    """Compare structs with those that a library was compiled with, member by member.

    Raises:
        ValueError: the first member that differs in name, offset or size.
    """
    compiled = _compiled_layout(library)
    for name, mirror in structs.items():
        places: dict[str, tuple[int, int]] = {}
        for member, *_ in mirror._fields_:
            field = getattr(mirror, member)
            places[f"{name}.{member}"] = (field.offset, field.size)
        places[name] = (0, ctypes.sizeof(mirror))
        for place, (offset, size) in places.items():
            if place not in compiled:
                raise ValueError(f"was compiled without {place}, which the headers declare")
            if compiled[place] != (offset, size):
                there = "has {1} bytes at {0}".format(*compiled[place])
                raise ValueError(f"does not agree with the headers: {place} {there}, not {size} at {offset}")
            del compiled[place]
    if compiled:
        raise ValueError(f"was compiled with {next(iter(compiled))}, which the headers do not declare")


def declare(library: ctypes.CDLL, declared: Declarations, structs: Mapping[str, type[Struct]]) -> None:
    """Give the functions of a library the types that headers declare.

    Raises:
        ValueError: the library lacks one.
    """
    for name, function in declared.functions.items():
        try:
            symbol = getattr(library, name)
        except AttributeError:
            raise ValueError(f"lacks the function {name}, which the headers declare") from None
        symbol.restype = _returned(function)
        symbol.argtypes = [_kind_of_parameter(parameter, structs) for parameter in function.parameters]


def fill(member: Any, values: ArrayLike) -> None:
    """Copy numbers into an array of a struct, of its shape or one that broadcasts to it."""
    np.ctypeslib.as_array(member)[...] = values


def set_members(struct: Struct, /, **values: ArrayLike) -> None:
    """Set numbers and arrays of a struct; as many numbers as an array has, in any shape."""
    for name, value in values.items():
        member = getattr(struct, name)
        if isinstance(member, ctypes.Array):
            numbers = np.ctypeslib.as_array(member)
            numbers[...] = np.reshape(value, numbers.shape)
        else:
            setattr(struct, name, value)


@cache
def _declared() -> Declarations:
    headers = [file for file in sources(ROOT) if file.suffix == ".h"]
    if not headers:
        raise FileError(ROOT / FOLDERS[0], f"the C headers are missing; {remedy(ROOT)}")
    try:
        return read_headers(headers)
    except HeaderError as error:
        raise FileError(error.path, error.problem) from error


@cache
def _structs() -> dict[str, type[Struct]]:
    return make_structs(_declared())


def _compiled_layout(library: ctypes.CDLL) -> dict[str, tuple[int, int]]:
    """Offsets and sizes of structs and their members in a library, by name."""
    try:
        first = ctypes.addressof(_Place.in_dll(library, "quadsim_layout"))
    except ValueError:
        raise ValueError("has no table of its structs") from None
    places: dict[str, tuple[int, int]] = {}
    while True:
        place = _Place.from_address(first + len(places) * ctypes.sizeof(_Place))
        if place.name is None:
            return places
        places[place.name.decode()] = (place.offset, place.size)


def _kind_of_member(member: Variable, structs: Mapping[str, type[Struct]]) -> Any:
    if member.pointer:
        return ctypes.c_void_p
    kind: Any = structs.get(member.type)
    if kind is None:
        kind = _KINDS[member.type]
    for size in reversed(member.shape):
        kind = kind * size
    return kind


def _kind_of_parameter(parameter: Variable, structs: Mapping[str, type[Struct]]) -> Any:
    if not parameter.pointer:
        return _KINDS[parameter.type]
    if parameter.type in structs:
        return ctypes.POINTER(structs[parameter.type])
    return ctypes.c_void_p


def _returned(function: Function) -> Any:
    returned = function.returned
    if returned.pointer:
        if returned.type == "char":
            return ctypes.c_char_p
        return ctypes.c_void_p
    if returned.type == "void":
        return None
    return _KINDS[returned.type]
