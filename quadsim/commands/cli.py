"""The `quadsim` command: it parses the line, calls a function of `quadsim.commands.app`, and shows the result.

Exit status: 0 done; 1 a required constraint is violated, or the flight was aborted; 2 invalid input.  That of an
interrupted command is `quadsim.commands.entry`'s.
"""

from __future__ import annotations

import contextlib
import json as serialising
import logging
import os
import re
import sys
from collections.abc import Callable, Iterator, Sequence
from inspect import BoundArguments
from pathlib import Path
from typing import Annotated, Any, Final

from cyclopts import CycloptsError, Parameter

from quadsim.commands.app import app
from quadsim.console.results import EXIT_FAILED, EXIT_WRONG_INPUT, Document, Result
from quadsim.errors import QuadsimError, printable

_MOST_LINES: Final = 21
_LONGEST_LINE: Final = 1000
"""Lines of a message that are shown, and characters of each: one with many problems has a line for each."""
_HOME: Final = re.compile(r"(--[\w-]+=)?(~.*)", re.DOTALL)

app.suppress_keyboard_interrupt = app.meta.suppress_keyboard_interrupt = False  # otherwise Ctrl-C ends it silently
app.register_install_completion_command(help="Install completion for this shell: commands, options, scenarios.")


@app.meta.default
def _parse(
    *words: Annotated[str, Parameter(show=False, allow_leading_hyphen=True)],
    json: Annotated[bool, Parameter(negative="", help="print the result alone, as JSON on stdout.")] = False,
) -> tuple[Callable[..., object], BoundArguments, bool]:
    """A command, its arguments, and whether its result is printed as JSON."""
    command, bound, ignored = app.parse_args(words, exit_on_error=False, print_error=False)
    if json and "progress" in ignored:
        bound.arguments["progress"] = False
    if not json and "flown" in ignored:
        bound.arguments["flown"] = _EarlyPrint()
    return command, bound, json


class _EarlyPrint:
    """Prints a result before its figures and its films are made, and remembers that it has."""

    shown = False

    def __call__(self, result: Result) -> None:
        from quadsim.console import console

        self.shown = True
        console.show(result.shown())


def _stdout_for(json: bool) -> contextlib.AbstractContextManager[None]:
    """Keep stdout for the result where it is JSON."""
    if not json:
        return contextlib.nullcontext()
    from quadsim.border import printing_to_stderr  # with numpy, which the help does not need

    return printing_to_stderr()


def _show(result: object, json: bool, early: _EarlyPrint | None) -> int:
    """Print a result, or where that was done early, the outputs added since; returns its exit status."""
    if isinstance(result, Path):
        from quadsim.console.console import short_path

        result = Document(f"written to {printable(short_path(result))}\n", str(result))
    if not isinstance(result, Result):
        return 0
    if json:
        print(serialising.dumps(result.to_json(), indent=2))
    elif early is not None and early.shown:
        from quadsim.console import console

        console.show(result.outputs())
    else:
        result.show()
    return result.exit_status


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns the exit status."""
    if arguments is None:
        arguments = sys.argv[1:]
    words = [_at_home(word) for word in arguments]
    try:
        if not words:
            app.help_print()
            return EXIT_WRONG_INPUT
        with _notices():
            status = _run(words)
        sys.stdout.flush()
        return status
    except CycloptsError as error:
        _complain(error)
        return EXIT_WRONG_INPUT
    except QuadsimError as error:
        _complain(error)
        return error.exit_status
    except SystemExit as error:  # raised by imported code; in flight it would abort the flight
        if isinstance(error.__context__, BrokenPipeError):  # rich's way to end
            return EXIT_FAILED
        print(f"quadsim: code that was loaded asks Python to exit (status {error.code!r:.80})", file=sys.stderr)
        return EXIT_WRONG_INPUT
    except BrokenPipeError:  # the reader of our output went away, e.g. `quadsim check RUN | head`: no verdict was read
        _silence_stdout()
        return EXIT_FAILED
    except OSError as error:  # ours are QuadsimErrors: this one is stdout's
        print(f"quadsim: cannot write the output: {error.strerror or error}", file=sys.stderr)
        _silence_stdout()
        return EXIT_WRONG_INPUT


def _run(words: Sequence[str]) -> int:
    """Parse the line, run its command and show the result; returns the exit status."""
    parsed: Any = app.meta(words, exit_on_error=False, print_error=False, result_action="return_value")
    if parsed is None:  # as after --help
        return 0
    command, bound, json = parsed
    early = bound.arguments.get("flown")
    try:
        with _stdout_for(json):
            result = command(*bound.args, **bound.kwargs)
        return _show(result, json, early)
    except QuadsimError as error:  # a failure may carry a partial result
        _show(error.result, json, early)
        raise


def _at_home(word: str) -> str:
    """Expand `~` in a word as a shell does, also in `--out=~/x`."""
    match = _HOME.fullmatch(word)
    if match is None:
        return word
    return (match[1] or "") + os.path.expanduser(match[2])  # noqa: PTH111


def _complain(error: Exception) -> None:
    """Print some twenty lines of a message."""
    from quadsim.console import console

    lines = printable(f"quadsim: {error}", keep="\n").split("\n")
    shown: list[Any] = []
    for line in lines[:_MOST_LINES]:
        if len(line) > _LONGEST_LINE:
            line = f"{line[:_LONGEST_LINE]} ..."
        shown.append(line)
    if len(lines) > _MOST_LINES:
        shown.append(f"... and {len(lines) - _MOST_LINES} more")
    console.show(shown, console.stderr())


class _Notices(logging.Handler):
    """Prints each message once, above the bars of progress."""

    def __init__(self) -> None:
        super().__init__()
        self._shown: set[str] = set()

    def emit(self, record: logging.LogRecord) -> None:
        """See `logging.Handler.emit`."""
        from quadsim.console import console

        message = record.getMessage()
        if message not in self._shown:
            self._shown.add(message)
            console.say(message)


@contextlib.contextmanager
def _notices() -> Iterator[None]:
    """Show notices on stderr, each once: which user code was imported, and what failed."""
    logger = logging.getLogger("quadsim")
    handler = _Notices()
    before = logger.level
    logger.addHandler(handler)
    logger.setLevel(logging.INFO)
    try:
        yield
    finally:
        logger.removeHandler(handler)
        logger.setLevel(before)


def _silence_stdout() -> None:
    """Send the rest of stdout nowhere, so that Python does not fail on it at its exit."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
