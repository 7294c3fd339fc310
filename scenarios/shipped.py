"""What ships, by name, from scenarios to papers.  Found without anything heavy, for `quadsim list`."""

from __future__ import annotations

from pathlib import Path
from typing import Final, Literal

from quadsim.errors import FileError, UnknownNameError

LIBRARY: Final = Path(__file__).resolve().parent / "library"
CAMPAIGNS: Final = Path(__file__).resolve().parent / "campaigns"
TUNINGS: Final = Path(__file__).resolve().parent / "tunings"
PAPERS: Final = Path(__file__).resolve().parent / "papers"

Group = Literal["paper", "papers", "courses", "air", "faults", "ground", "space", "sensors", "other"]

CONTROLLERS: Final = {
    "unconstrained": "the paper's Sec. 4: a constant gain from the unconstrained optimum",
    "constrained": "the paper's Sec. 5: a QP's optimum in every period, tilt, rotor speeds and their steps bounded",
    "robust": "constrained, with soft bounds, rotor lag, delay, disturbances, heading and more, each switched on alone",
    "nonlinear": "nonlinear MPC at any attitude: a quaternion model, sequential quadratic programming",
    "lqr": "infinite-horizon LQR on the hover model, following the reference's velocity",
    "pid": "cascaded PID, as autopilots fly it",
    "geometric": "geometric tracking control on SE(3)",
}


def scenario_names() -> list[str]:
    """Names of the scenarios that ship, sorted."""
    return _names(LIBRARY)


def scenario_path(name: str) -> Path:
    """The file of a library name, or the path itself when it ends in `.toml`.

    Raises:
        FileError, UnknownNameError: there is none.
    """
    return _path("scenario", name, LIBRARY)


def campaign_names() -> list[str]:
    """Names of the campaigns that ship, sorted."""
    return _names(CAMPAIGNS)


def campaign_path(name: str) -> Path:
    """The file of a campaign that ships; as `scenario_path`."""
    return _path("campaign", name, CAMPAIGNS)


def tuning_names() -> list[str]:
    """Names of the tunings that ship, sorted."""
    return _names(TUNINGS)


def tuning_path(name: str) -> Path:
    """The file of a tuning that ships; as `scenario_path`."""
    return _path("tuning", name, TUNINGS)


def paper_names() -> list[str]:
    """Names of the papers whose numbers ship, sorted."""
    return _names(PAPERS)


def paper_path(name: str) -> Path:
    """The file of a paper that ships; as `scenario_path`."""
    return _path("paper", name, PAPERS)


def _names(folder: Path) -> list[str]:
    return sorted(path.stem for path in folder.glob("*.toml"))


def _path(kind: str, name: str, folder: Path) -> Path:
    if name.endswith(".toml"):
        if not Path(name).is_file():
            raise FileError(name, f"no such {kind} file")
        return Path(name)
    if name not in _names(folder):
        raise UnknownNameError(kind, name, _names(folder), hint="or give a path ending in .toml")
    return folder / f"{name}.toml"
