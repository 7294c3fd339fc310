"""What ships, by name, from scenarios to papers.  Found without anything heavy, for `quadsim list`."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Final, Literal

from quadsim.errors import FileError, UnknownNameError

_HERE: Final = Path(__file__).resolve().parent
LIBRARY, CAMPAIGNS, TUNINGS, PAPERS = (_HERE / name for name in ("library", "campaigns", "tunings", "papers"))

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


def _names(folder: Path) -> list[str]:
    """Names of what ships in a folder, sorted."""
    return sorted(path.stem for path in folder.glob("*.toml"))


def _path(kind: str, folder: Path, name: str) -> Path:
    """The file of a name that ships, or the path itself where it ends in `.toml`; refused where there is none."""
    if name.endswith(".toml"):
        if not Path(name).is_file():
            raise FileError(name, f"no such {kind} file")
        return Path(name)
    if name not in _names(folder):
        raise UnknownNameError(kind, name, _names(folder), hint="or give a path ending in .toml")
    return folder / f"{name}.toml"


scenario_names, scenario_path = partial(_names, LIBRARY), partial(_path, "scenario", LIBRARY)
campaign_names, campaign_path = partial(_names, CAMPAIGNS), partial(_path, "campaign", CAMPAIGNS)
tuning_names, tuning_path = partial(_names, TUNINGS), partial(_path, "tuning", TUNINGS)
paper_names, paper_path = partial(_names, PAPERS), partial(_path, "paper", PAPERS)
