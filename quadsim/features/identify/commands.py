"""The command `quadsim identify`.

It estimates a vehicle's parameters from flight logs, each with an interval, by maximum likelihood of the prediction
errors (`quadsim.features.identify.search`), and compares predictions on logs that were held back.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from quadsim.errors import InputError, ParameterError
from quadsim.features.arguments import File, Files, Flag, VehicleName, Whole

if TYPE_CHECKING:
    from quadsim.features.identify.report import IdentifiedVehicle
else:
    IdentifiedVehicle = Any


def identify(
    *logs: File,
    vehicle: VehicleName | None = None,
    test: Files = (),
    out: File | None = None,
    page: File | None = None,
    overwrite: Flag = False,
    poles: Whole | None = None,
    columns: File | None = None,
    wind: Flag = False,
    anyway: Flag = False,
) -> IdentifiedVehicle:
    """Identify a vehicle from flight logs: its file, with an interval for every number.

    Args:
        logs: flights of one vehicle: CSV, Parquet, logs of PX4, ArduPilot, Betaflight or Crazyflie, bags of ROS, or run
            directories.
        vehicle: start: a vehicle's name, or path to a TOML file with its mass, arm length and rotor layout.
        test: log to predict and not to fit; may be repeated (default: the last fifth of each log, which is not fitted).
        out: TOML file for the identified vehicle (default: none is written).
        page: HTML file for the page: intervals, and measured against predicted.
        overwrite: replace existing files.
        poles: magnets of a motor, where a log has its electrical speed.
        columns: TOML file that says which columns of the logs are which quantity, in which unit, sign and frame.
        wind: seek the wind too; where no position is logged, that is always done.
        anyway: write the vehicle file even where the start, or the thrust alone, predicts better.

    Returns:
        The `vehicle`; its `identification` (estimates with intervals and verdicts); the `prediction` of flight that was
        not fitted; what to fly to learn the rest, `advice`.

    Raises:
        InputError: a log cannot be used, or the vehicle that it gives cannot fly.
        OutputError: a file exists, or cannot be written.

    Examples:
        >>> import quadsim
        >>> quadsim.identify("not-logged-yet.csv", vehicle="hummingbird")
        Traceback (most recent call last):
        quadsim.errors.FileError: not-logged-yet.csv: is missing, or not a file
    """
    from quadsim.assets import vehicle_path
    from quadsim.features.identify.quantities import read_map
    from quadsim.features.identify.report import identify_logs

    if not logs:
        raise InputError("identify needs a flight log: CSV, Parquet, an autopilot's, or a run directory")
    if vehicle is None:
        raise InputError(_start_file_advice(logs))
    for option, path, suffix in (("--out", out, ".toml"), ("--page", page, ".html")):
        if path is not None and Path(path).suffix != suffix:
            raise ParameterError("", option, str(path), f"a file ending in {suffix}")
    fitted = [Path(log) for log in logs]
    tested = [Path(log) for log in test]
    _require_unfitted(tested, fitted)
    return identify_logs(
        fitted,
        vehicle_path(str(vehicle)),
        test=tested,
        poles=poles,
        columns=() if columns is None else read_map(Path(columns)),
        out=None if out is None else Path(out),
        page=None if page is None else Path(page),
        overwrite=overwrite,
        wind=wind,
        anyway=anyway,
    )


def _start_file_advice(logs: Sequence[File]) -> str:
    """How to make the start file that is missing; the rotors that a log states are part of it."""
    from quadsim.features.identify.report import NEEDED_PARAMETERS
    from quadsim.features.identify.ulog import stated_rotors

    advice = (
        "identify needs --vehicle, a start: mass and arm are in no log; quadsim vehicle --template > start.toml"
        f" writes one; give your {NEEDED_PARAMETERS}, and estimates of the rest"
    )
    for log in logs:
        rotors = stated_rotors(Path(log))
        if rotors:
            return f"{advice}. The log has the rotors, in place of arm_length and rotor_azimuths: {rotors}"
    return advice


def _require_unfitted(tested: Sequence[Path], fitted: Sequence[Path]) -> None:
    """Refuse a log that is both fitted and tested."""
    resolved = {log.resolve() for log in fitted}
    for log in tested:
        if log.resolve() in resolved:
            raise ParameterError("", "--test", str(log), "a log that is not fitted too")
