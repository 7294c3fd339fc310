"""Libraries that read logs, the extra `logs`: what they lack and raise, as our errors."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from quadsim.errors import FileError, InputError, MissingPackageError


@contextmanager
def reading(path: Path, what: str, library: str) -> Iterator[None]:
    """Read a log by a library that is imported within, and that raises whatever its parsing meets.

    Raises:
        MissingPackageError: the library is not installed.
        FileError: it cannot read the log.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingPackageError(f"a {what}", library, extra="logs") from error
    except InputError:
        raise
    except Exception as error:
        raise FileError(path, f"is not a readable {what} ({str(error)[:80]})") from error
