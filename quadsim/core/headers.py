"""What the headers of quadsim's C declare: enumerators, structs and functions.

The headers are the only declaration of these; Python's mirrors follow from it (`quadsim.core.mirror`), and so does the
table of offsets that is compiled into the library (`layout_source`).  This file needs only the standard library:
`build.py` loads it where nothing of quadsim can be imported.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final, NamedTuple

ENUM: Final = "enum"
"""The type of a value of an enumeration."""
NUMBERS: Final = frozenset(
    ["int", "long", "float", "double", "char", "signed char", "unsigned char", "int64_t", "uint8_t", ENUM]
)
"""Types of numbers."""

_COMMENT: Final = re.compile(r"/\*.*?\*/", re.DOTALL)
_SPACE: Final = re.compile(r"\s*")
_DIRECTIVE: Final = re.compile(r"^[ \t]*#(?:.*\\\n)*.*", re.MULTILINE)
_STATIC: Final = re.compile(r"static\b[^;{]*")
_BRACE: Final = re.compile(r"[{};]")
_ENUM: Final = re.compile(r"enum\b\s*\w*\s*\{([^{}]*)\}\s*;")
_STRUCT: Final = re.compile(r"typedef\s+struct\s+(\w+)\s*\{([^{}]*)\}\s*(\w+)\s*;")
_TYPEDEF: Final = re.compile(r"typedef\s+([\w\s]+?)\s+(\w+)\s*;")
_FUNCTION: Final = re.compile(r"(\w[\w\s]*?(?:\s+|\s*\*+\s*))(\w+)\s*\(([^;{}()]*)\)\s*;")
_MEMBER: Final = re.compile(r"([\w\s]+?)((?:\s*\*+\s*|\s+)\w+(?:\s*\[[^\[\]]*\])*)")
_DECLARATOR: Final = re.compile(r"\s*(\**)\s*(\w+)((?:\s*\[[^\[\]]*\])*)\s*")
_SIZE: Final = re.compile(r"\[([^\]]*)\]")
_FUNCTION_POINTER: Final = re.compile(r"[\w\s*]+\(\s*\*\s*(\w+)\s*\)\s*\([^()]*\)")
_RETURNED: Final = re.compile(r"([\w\s]+?)\s*(\**)\s*")


class HeaderError(ValueError):
    """A header has something that cannot be mirrored.

    Attributes:
        path: the header.
        problem: the line, and what is wrong there.
    """

    def __init__(self, path: Path, line: int, problem: str) -> None:
        super().__init__(f"{path}: line {line}: {problem}")
        self.path = path
        self.problem = f"line {line}: {problem}"


class Variable(NamedTuple):
    """A member of a struct, a parameter of a function, or what it returns."""

    name: str
    type: str
    """One of `NUMBERS`, `void`, or the name of a struct; of a pointer what it points to."""
    pointer: bool
    shape: tuple[int, ...]
    """Of an array, else ()."""


class Function(NamedTuple):
    """A function."""

    returned: Variable
    parameters: tuple[Variable, ...]


class Declarations(NamedTuple):
    """What headers declare, by name."""

    constants: Mapping[str, int]
    """Enumerators."""
    structs: Mapping[str, tuple[Variable, ...]]
    functions: Mapping[str, Function]
    headers: tuple[str, ...]
    """Names of the files with structs."""


def read_headers(files: Iterable[Path]) -> Declarations:
    """Read headers, and what these include of one another.

    What is read is C99 in a plain form, and anything else is a `HeaderError` that names the line:

    - `enum NAME { A, B = 1, C = A + 2 * B };`
    - `typedef struct NAME { ... } NAME;`, its members numbers, structs, arrays of these, and pointers, also to
      functions;
    - `typedef double NAME;`
    - prototypes of functions that take and return numbers and pointers.

    `static` definitions are left out, and code of macros that are not defined: `#ifdef`, `#ifndef` and `#else` decide,
    but no declaration may stand under `#if`.  A name means the same in all headers.

    Raises:
        HeaderError: one has something that cannot be mirrored.
    """
    reader = _Reader(files)
    for name in reader.files:
        reader.read(name)
    return Declarations(reader.constants, reader.structs, reader.functions, tuple(reader.with_structs))


def layout_source(declared: Declarations) -> str:
    """Return C of a table `quadsim_layout`: where the compiler puts each struct's members, by name, offset and size.

    A struct has its name and size first, a member `struct.member`; an entry without a name is the last.
    """
    lines = ["#include <stddef.h>"]
    for header in declared.headers:
        lines.append(f'#include "{header}"')
    lines.append("typedef struct quadsim_place {")
    lines.append("    const char *name;")
    lines.append("    size_t offset, size;")
    lines.append("} quadsim_place;")
    lines.append("extern const quadsim_place quadsim_layout[];")
    lines.append("const quadsim_place quadsim_layout[] = {")
    for struct, members in declared.structs.items():
        lines.append(f'    {{"{struct}", 0, sizeof({struct})}},')
        for member in members:
            place = f"offsetof({struct}, {member.name}), sizeof((({struct} *)0)->{member.name})"
            lines.append(f'    {{"{struct}.{member.name}", {place}}},')
    lines.append("    {NULL, 0, 0},")
    lines.append("};")
    return "\n".join(lines) + "\n"


class _Reader:
    """Reads headers one after another, each after those that it includes."""

    def __init__(self, files: Iterable[Path]) -> None:
        self.files = {file.name: file for file in files}
        self.constants: dict[str, int] = {}
        self.structs: dict[str, tuple[Variable, ...]] = {}
        self.functions: dict[str, Function] = {}
        self.with_structs: list[str] = []
        self._types: dict[str, str] = {}  # what a typedef stands for
        self._known: dict[str, str] = {}  # what `type_of` has found
        self._macros: set[str] = set()
        self._read: set[str] = set()

    def read(self, name: str) -> None:
        """Read a header, unless it has been read."""
        if name in self._read:
            return
        self._read.add(name)
        path = self.files[name]
        text = _COMMENT.sub(_blank, path.read_text(encoding="utf-8"))
        _File(self, path, self._compiled(path, text)).read()

    def _compiled(self, path: Path, text: str) -> str:
        """Return the code that the preprocessor leaves, on the same lines; read what is included."""
        parts: list[str] = []
        # Of each #if around some code: whether it holds; None where that is not known.
        holds: list[bool | None] = []
        end = 0
        for found in _DIRECTIVE.finditer(text):
            parts.append(self._used(path, text, end, found.start(), holds))
            line = text.count("\n", 0, found.start()) + 1
            self._directive(path, line, found[0], holds)
            parts.append("\n" * found[0].count("\n"))
            end = found.end()
        parts.append(self._used(path, text, end, len(text), holds))
        return "".join(parts)

    def _used(self, path: Path, text: str, start: int, end: int, holds: list[bool | None]) -> str:
        """Return the code between two places if it is compiled, else its line ends."""
        code = text[start:end]
        if False in holds:
            return "\n" * code.count("\n")
        if None in holds and code.strip():
            line = text.count("\n", 0, end - len(code.lstrip())) + 1
            raise HeaderError(path, line, "a declaration under #if: use #ifdef, #ifndef or #else")
        return code

    def _directive(self, path: Path, number: int, line: str, holds: list[bool | None]) -> None:
        """Follow a directive: whether code around which it stands holds, what is defined, what is included."""
        directive = line.strip().removeprefix("#").strip()
        word = re.split(r"\s", directive)[0]
        rest = directive.removeprefix(word).strip()
        if word in ("ifdef", "ifndef"):
            holds.append((rest in self._macros) == (word == "ifdef"))
        elif word == "if":
            holds.append(None)
        elif word in ("elif", "else", "endif") and not holds:
            raise HeaderError(path, number, f"#{word} without #if")
        elif word == "elif":
            holds[-1] = None
        elif word == "else":
            if holds[-1] is not None:
                holds[-1] = not holds[-1]
        elif word == "endif":
            holds.pop()
        elif word == "define":
            if all(holds):
                self._macros.add(re.split(r"\W", rest)[0])
        elif word == "include":
            name = rest.strip('"<>')
            if False not in holds and rest.startswith('"'):
                if name not in self.files:
                    raise HeaderError(path, number, f"{name} is not among quadsim's headers")
                self.read(name)
        elif word not in ("error", "undef"):
            raise HeaderError(path, number, f"#{word} is not known here")

    def define(self, name: str, value: int) -> bool:
        """Define an enumerator; return whether that agrees with other headers."""
        return self.constants.setdefault(name, value) == value

    def define_type(self, name: str, of: str) -> bool:
        """Define a type; return whether that agrees with other headers."""
        return self._types.setdefault(name, of) == of

    def type_of(self, words: str) -> str | None:
        """Return one of `NUMBERS`, `void` or a struct of words such as `const quadsim_real`; None if not known."""
        if words in self._known:
            return self._known[words]
        parts = words.split()
        if "const" in parts:
            parts.remove("const")
        name = " ".join(parts)
        name = self._types.get(name, name)
        if len(parts) == 2 and parts[0] == ENUM:
            name = ENUM
        elif name == ENUM or not (name in NUMBERS or name == "void" or name in self.structs):
            return None
        self._known[words] = name
        return name


class _File:
    """One header's code."""

    def __init__(self, reader: _Reader, path: Path, text: str) -> None:
        self._reader = reader
        self._path = path
        self._text = text

    def read(self) -> None:
        """Read all declarations."""
        at = self._after_space(0)
        while at < len(self._text):
            definition = _STATIC.match(self._text, at)
            if definition is not None:
                at = self._end_of_definition(at, definition.end())
            else:
                at = self._read_declaration(at)
            at = self._after_space(at)

    def _read_declaration(self, at: int) -> int:
        """Read the declaration at a place, of the first kind that it has the form of; returns its end."""
        kinds = (
            (_ENUM, self._enumerators),
            (_STRUCT, self._struct),
            (_TYPEDEF, self._typedef),
            (_FUNCTION, self._function),
        )
        for pattern, read in kinds:
            found = pattern.match(self._text, at)
            if found is not None:
                read(at, found)
                return found.end()
        raise self._error(at, f"{self._shown(at)!r} is not known here; see quadsim/core/headers.py")

    def _after_space(self, at: int) -> int:
        found = _SPACE.match(self._text, at)
        assert found is not None
        return found.end()

    def _end_of_definition(self, start: int, at: int) -> int:
        """Return the end of a static function or constant whose body or semicolon is at a place."""
        depth = 0
        for brace in _BRACE.finditer(self._text, at):
            if brace[0] == "{":
                depth += 1
            elif brace[0] == "}":
                depth -= 1
            if depth == 0 and brace[0] == ";":
                return brace.end()
            if depth == 0 and "=" not in self._text[start:at]:
                return brace.end()
        raise self._error(start, "this definition does not end")

    def _enumerators(self, at: int, found: re.Match[str]) -> None:
        """Define the enumerators of an enumeration."""
        value = -1
        at = found.start(1)
        for entry in found[1].split(","):
            name, _, stated = entry.partition("=")
            name = name.strip()
            if name:
                if stated:
                    value = self._number(at, stated)
                else:
                    value += 1
                if not re.fullmatch(r"\w+", name):
                    raise self._error(at, f"{name!r} is not an enumerator")
                if not self._reader.define(name, value):
                    raise self._error(at, f"{name} is {value} here, and {self._reader.constants[name]} elsewhere")
            at += len(entry) + 1

    def _typedef(self, at: int, found: re.Match[str]) -> None:
        """Define another name of a type."""
        of = self._type(at, found[1])
        if not self._reader.define_type(found[2], of):
            raise self._error(at, f"{found[2]} is {of} here, and another type elsewhere")

    def _struct(self, at: int, found: re.Match[str]) -> None:
        """Declare a struct, member by member."""
        tag, body, name = found.groups()
        if tag != name:
            raise self._error(at, f"struct {tag} must have one name, not also {name}")
        if name in self._reader.structs:
            raise self._error(at, f"struct {name} is declared twice")
        members: list[Variable] = []
        at = found.start(2)
        for statement in body.split(";"):
            if statement.strip():
                members += self._members(at + len(statement) - len(statement.lstrip()), statement.strip())
            at += len(statement) + 1
        self._reader.structs[name] = tuple(members)
        if self._path.name not in self._reader.with_structs:
            self._reader.with_structs.append(self._path.name)

    def _members(self, at: int, statement: str) -> list[Variable]:
        """Return the members of a statement such as `const double *a, b[3]`."""
        function = _FUNCTION_POINTER.fullmatch(statement)
        if function is not None:
            return [Variable(function[1], "void", True, ())]
        first, *others = statement.split(",")
        found = _MEMBER.fullmatch(first)
        if found is None:
            raise self._error(at, f"{statement!r} is not a member that can be mirrored")
        kind = self._type(at, found[1])
        members: list[Variable] = []
        for text in (found[2], *others):
            declarator = _DECLARATOR.fullmatch(text)
            if declarator is None:
                raise self._error(at, f"{text.strip()!r} is not a member that can be mirrored")
            pointer = bool(declarator[1])
            shape = self._shape(at, declarator[3])
            if (pointer and shape) or (kind == "void" and not pointer):
                raise self._error(at, f"{text.strip()!r} is not a member that can be mirrored")
            members.append(Variable(declarator[2], kind, pointer, shape))
        return members

    def _function(self, at: int, found: re.Match[str]) -> None:
        """Declare a function by its prototype."""
        returned, name, given = found.groups()
        parameters: list[Variable] = []
        for text in given.split(","):
            if given.strip() != "void":
                parameters.append(self._parameter(at, text.strip()))
        result = _RETURNED.fullmatch(returned)
        assert result is not None
        pointer = bool(result[2])
        if name in self._reader.functions:
            raise self._error(at, f"{name} is declared twice")
        kind = self._type(at, result[1])
        self._reader.functions[name] = Function(Variable("", kind, pointer, ()), tuple(parameters))

    def _parameter(self, at: int, text: str) -> Variable:
        """Return a parameter such as `const double *a`; an array is a pointer."""
        found = _MEMBER.fullmatch(text)
        declarator = None
        if found is not None:
            declarator = _DECLARATOR.fullmatch(found[2])
        if found is None or declarator is None:
            raise self._error(at, f"{text!r} is not a parameter that can be mirrored")
        kind = self._type(at, found[1])
        pointer = bool(declarator[1] or declarator[3])
        if not pointer and kind not in NUMBERS:
            raise self._error(at, f"{text!r} is not a parameter that can be mirrored: pass its address")
        return Variable(declarator[2], kind, pointer, ())

    def _type(self, at: int, words: str) -> str:
        """Return the type that words such as `const quadsim_real` name; see `_Reader.type_of`."""
        known = self._reader.type_of(words)
        if known is None:
            raise self._error(at, f"type {' '.join(words.split())!r} is not known here; see quadsim/core/headers.py")
        return known

    def _shape(self, at: int, sizes: str) -> tuple[int, ...]:
        """Return the shape of an array from its sizes in brackets, such as `[4][N]`."""
        if not sizes:
            return ()
        return tuple(self._number(at, size) for size in _SIZE.findall(sizes))

    def _number(self, at: int, text: str) -> int:
        """Return a sum of products of numbers and enumerators."""
        total = 0
        for term in text.split("+"):
            product = 1
            for factor in map(str.strip, term.split("*")):
                if factor.isdecimal():
                    product *= int(factor)
                elif factor in self._reader.constants:
                    product *= self._reader.constants[factor]
                else:
                    raise self._error(at, f"{text.strip()!r} is not a sum of products of numbers and enumerators")
            total += product
        return total

    def _shown(self, at: int) -> str:
        """Return the line at a place, for a message."""
        line = self._text[at:].split("\n", 1)[0]
        if len(line) <= 60:
            return line
        return f"{line[:57]}..."

    def _error(self, at: int, problem: str) -> HeaderError:
        return HeaderError(self._path, self._text.count("\n", 0, at) + 1, problem)


def _blank(comment: re.Match[str]) -> str:
    """Return as many lines as a comment has."""
    return "\n" * comment[0].count("\n") or " "
