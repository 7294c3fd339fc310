"""MPC as a teacher: what a scenario's controller would do, for each observation of some episodes, as a table."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadsim.errors import FlightError, ParameterError
from quadsim.outputs import require_file, writing_file
from quadsim.state import Array
from scenarios.gym.actions import Action
from scenarios.gym.registration import make_env
from scenarios.schema.scenario import Scenario

if TYPE_CHECKING:
    import pyarrow as pa

Agent = Callable[[Array], Action]


def expert(
    scenario: Scenario | str | Path,
    *,
    episodes: int = 1,
    seed: int | None = None,
    agent: Agent | None = None,
    out: str | Path | None = None,
    **options: Any,
) -> pa.Table:
    """What the scenario's own controller does, period by period.

    Args:
        scenario: it, or its name or file.
        episodes: how many; the first is reset with `seed`, the others without one.
        seed: as of `QuadrotorEnv.reset`.
        agent: flies instead of the controller, from an observation to an action; the table still has the
            controller's actions, as data aggregation (DAgger) wants them, as long as the controller has any.
        out: a Parquet file to write as well, where there is none yet.
        options: as of `make_env`; actions are deviations by default, and cannot be rates.

    Returns:
        A row per period: `episode`, `period`, `observation` and `action` (lists of fixed size), and the controller's
        `status` (`solved` and `unconstrained` where it had an optimum) and `violated` (whether the step violated a
        required constraint).  The metadata `layout` has the name and unit of each entry of an observation, as JSON.

    Raises:
        InputError: the scenario or an option is not possible.
        OutputError: the file cannot be written.

    Examples:
        >>> import quadsim, quadsim.gym
        >>> table = quadsim.gym.expert(quadsim.load("hover").replace({"duration": 1.0}), preview=5)
        >>> table.num_rows, len(table["observation"][0]), table["status"][0].as_py()
        (20, 36, 'unconstrained')
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    if episodes < 1:
        raise ParameterError("", "episodes", episodes, "at least 1")
    if out is not None:
        require_file(out)
    env = make_env(scenario, **options)
    base = env.unwrapped
    rows: dict[str, list[Any]] = {
        name: [] for name in ("episode", "period", "observation", "action", "status", "violated")
    }
    for episode in range(episodes):
        observed, _ = env.reset(seed=seed if episode == 0 else None)
        ended, period = False, 0
        while not ended:
            try:
                action = base.controller_action()
            except FlightError:
                break
            status = base.controller_status
            seen = observed
            observed, _, terminated, truncated, info = env.step(action if agent is None else agent(seen))
            values = (episode, period, seen, action, status, bool(info["constraint_violation"]))
            for column, value in zip(rows.values(), values, strict=True):
                column.append(value)
            ended, period = terminated or truncated, period + 1
    env.close()
    columns = {name: pa.array(rows[name]) for name in ("episode", "period", "status", "violated")}
    for name in ("observation", "action"):
        stacked = np.array(rows[name], float)
        columns[name] = pa.FixedSizeListArray.from_arrays(pa.array(stacked.ravel()), stacked.shape[1])
    layout = [vars(entry) for entry in base.observations.layout]
    table = pa.table({name: columns[name] for name in rows}).replace_schema_metadata(
        {"scenario": base.scenario.name, "layout": json.dumps(layout)}
    )
    if out is not None:
        buffer = pa.BufferOutputStream()
        pq.write_table(table, buffer, compression="zstd")
        with writing_file(out) as file:
            file.write_bytes(buffer.getvalue().to_pybytes())
    return table
