"""Workers as jobs of a batch system such as Slurm, as a TOML file describes them, through dask-jobqueue."""

from __future__ import annotations

import asyncio
import contextlib
import inspect
import shlex
import shutil
import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from quadsim.errors import FileError, InputError, MissingPackageError, ParameterError, UnknownNameError
from scenarios.campaign.engine.protocol import EngineError, describe

_OURS: Final = ("jobs", "cores")
_CLUSTER_ALONE: Final = ("scheduler_options", "shared_temp_directory")
"""Options of the scheduler that a job does not get."""
_NOT_TO_SET: Final = {
    *("self", "base_class_kwargs", "job_kwargs", "kwargs", "scheduler", "scheduler_cls", "job_cls", "name"),
    *("config_name", "loop", "asynchronous", "security", "silence_logs", "n_workers", "dashboard_address", "host"),
    *("processes", "extra", "job_extra", "env_extra", "header_skip"),
}
"""What dask-jobqueue's constructors take besides: of programs, old names, and `processes`, which is one per core."""


@dataclass(frozen=True, kw_only=True)
class Jobs:
    """Jobs of a batch system, each of which starts one worker per core."""

    system: str  # its name in dask-jobqueue, e.g. `slurm`
    jobs: int  # how many
    cores: int  # of each
    options: Mapping[str, Any]  # further options of dask-jobqueue, e.g. `memory`, `queue`, `walltime`

    @property
    def workers(self) -> int:
        """Workers of all jobs together."""
        return self.jobs * self.cores


def read_jobs(path: Path) -> Jobs:
    """Read and check a file with one table, named for a batch system.

    Raises:
        InputError: the file is missing or malformed, or a table, field or value is not allowed.
        MissingPackageError: dask-jobqueue is not installed.
    """
    try:
        data = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(path, f"cannot be read ({error.strerror})") from error
    except ValueError as error:  # of TOML, or of UTF-8
        raise FileError(path, f"is not TOML ({error})") from error
    clusters = _clusters()
    if len(data) != 1:
        what = f"must have one table, named for a batch system ({', '.join(sorted(clusters))})"
        raise FileError(path, f"{what}; it has {', '.join(data) or 'none'}")
    ((system, table),) = data.items()
    if system not in clusters:
        raise UnknownNameError("batch system", system, clusters)
    if not isinstance(table, dict):
        raise ParameterError("", system, table, f"a table: [{system}]")
    jobs = _checked(system, table, clusters[system])
    try:
        job_script(jobs)
    except InputError as error:
        raise FileError(path, str(error)) from error
    return jobs


def job_script(jobs: Jobs) -> str:
    """What is submitted for one job, but for the scheduler's address and the worker's name.

    Raises:
        InputError: dask-jobqueue refuses an option.
    """
    options = {name: value for name, value in jobs.options.items() if name not in _CLUSTER_ALONE}
    try:
        job = _clusters()[jobs.system].job_cls("SCHEDULER", "NAME", cores=jobs.cores, processes=jobs.cores, **options)
        return str(job.job_script())
    except (ValueError, TypeError, AttributeError, OSError) as error:
        raise InputError(f"[{jobs.system}] is refused by dask-jobqueue: {describe(error)}") from error


def submit(jobs: Jobs) -> Any:
    """Start them; closing the dask-jobqueue cluster that this returns ends them.

    Raises:
        EngineError: they cannot be submitted from this machine.
    """
    kind = _clusters()[jobs.system]
    command = str(kind.job_cls.submit_command).split()[0]
    if shutil.which(command) is None:
        raise EngineError(f"no command {command!r} here: start the campaign where jobs are submitted to {jobs.system}")
    scheduler = {"dashboard_address": ":0", **jobs.options.get("scheduler_options", {})}
    options = {**jobs.options, "scheduler_options": scheduler}
    with contextlib.ExitStack() as undone:
        try:
            cluster: Any = kind(cores=jobs.cores, processes=jobs.cores, **options)
            undone.callback(_close, cluster)
            cluster.scale(jobs=jobs.jobs)
            cluster.sync(_submitted, cluster)
        except (RuntimeError, ValueError, TypeError, OSError) as error:
            raise EngineError(f"{jobs.system} did not take the jobs: {describe(error)}") from error
        undone.pop_all()
    return cluster


async def _submitted(cluster: Any) -> None:
    """Wait for it; a job that was not taken is submitted again when waited for, and now its error is raised."""
    from distributed.core import Status

    await cluster
    jobs = list(cluster.workers.values())
    found = await asyncio.gather(*jobs, return_exceptions=True)
    failures = [(job, error) for job, error in zip(jobs, found, strict=True) if isinstance(error, BaseException)]
    for job, _ in failures:
        job.status = Status.failed  # or the cluster could not be closed
    for _, error in failures:
        raise error


def _close(cluster: Any) -> None:
    with contextlib.suppress(Exception):  # of jobs that never were
        cluster.close()


def _clusters() -> dict[str, Any]:
    """dask-jobqueue's cluster classes by the batch system's name."""
    try:
        import dask_jobqueue
    except ModuleNotFoundError as error:
        raise MissingPackageError("a cluster of jobs", "dask-jobqueue", extra="cluster") from error
    base = dask_jobqueue.JobQueueCluster
    kinds: list[Any] = [
        each for each in vars(dask_jobqueue).values() if inspect.isclass(each) and issubclass(each, base)
    ]
    return {kind.job_cls.config_name: kind for kind in kinds if kind is not base}


def _checked(system: str, table: Mapping[str, Any], kind: Any) -> Jobs:
    """The table, its names and the kinds of its values as allowed."""
    constructors = [each.__init__ for each in (*kind.__mro__, *kind.job_cls.__mro__) if "jobqueue" in each.__module__]
    taken = {name for each in constructors for name in inspect.signature(each).parameters} - _NOT_TO_SET
    for name, value in table.items():
        if name not in {*taken, *_OURS}:
            raise UnknownNameError(f"field in [{system}]", name, {*taken, *_OURS})
        if not _plain(value) and not (name == "scheduler_options" and isinstance(value, dict)):
            raise ParameterError(system, name, value, "a text in quotes, a number, true, false or a list of texts")
    for name in (*_OURS, "memory"):
        if name not in table:
            raise InputError(f"{system}.{name} is missing")
    for name in _OURS:
        if not isinstance(table[name], int) or isinstance(table[name], bool) or table[name] < 1:
            raise ParameterError(system, name, table[name], "a whole number of 1 or more")
    import dask

    python = dask.config.get(f"jobqueue.{system}.python", None) or shlex.quote(sys.executable)  # unquoted else
    options = {"python": python, **{name: value for name, value in table.items() if name not in _OURS}}
    return Jobs(system=system, jobs=table["jobs"], cores=table["cores"], options=options)


def _plain(value: object) -> bool:
    if isinstance(value, list):
        return all(isinstance(each, str) for each in value)
    return isinstance(value, str | int | float)
