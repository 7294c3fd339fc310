"""A campaign's directory: its plan, code and progress."""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from quadsim.assets import models_dir
from quadsim.errors import FileError, InputError
from quadsim.flight.summary import read_json, require_inside
from quadsim.outputs import SUMMARY_FILE, Growing, digest_of, to_json
from scenarios.campaign.plan import Plan, load_plan
from scenarios.campaign.results.store import FLIGHTS_FILE, TIMES_FILE
from scenarios.campaign.spec import CampaignSpec
from scenarios.machine import machine, versions
from scenarios.parts.controllers import make_controller
from scenarios.parts.plugin import import_plugin
from scenarios.parts.vehicle import build_vehicle
from scenarios.schema.plugin import ForceSpec, PluginSpec
from scenarios.schema.scenario import Scenario

MANIFEST_FILE: Final = "manifest.json"
CAMPAIGN_FILE: Final = "campaign.toml"
SCENARIO_FILE: Final = "scenario.toml"
FORMAT: Final = "quadsim campaign"
_FORM: Final = {
    **dict.fromkeys(("format", "name", "status"), str),
    **dict.fromkeys(("flights", "flown"), int),
    "sessions": list,
}
_ROOT: Final = Path(__file__).resolve().parents[2]


def begin(plan: Plan, files: Growing) -> dict[str, Any]:
    """Write the files that define a campaign, its manifest last, and return that.

    Raises:
        OutputError: they cannot be written, or files of these names that we did not write are there.
    """
    files.write(_texts(plan))
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "name": plan.spec.name,
        "description": plan.spec.description,
        "scenario": plan.scenario.name,
        "status": "running",
        "flights": plan.spec.flights,
        "flown": 0,
        **flown_by(plan),
        "sessions": [],
    }
    write(manifest, files)
    return manifest


def go_on(plan: Plan, files: Growing, *, flying: bool) -> dict[str, Any]:
    """The manifest of a campaign that is resumed, perhaps with more flights; see `require_same`.

    Raises:
        FileError: there is none, or it is damaged.
        InputError: something has to be flown, and other code would fly it.
        OutputError: it cannot be written.
    """
    manifest = read_manifest(files.path)
    if flying:
        differing = [name for name in other_than_flew(manifest, plan) if name != "machine"]
        if differing:
            raise InputError(
                f"{files.path}: --resume needs the same code, and this one differs from what flew the "
                f"first flights ({', '.join(differing)}): half of the numbers would be another program's; choose "
                "another --out"
            )
    manifest |= {"status": "running", "flights": plan.spec.flights}
    files.remove([SUMMARY_FILE])  # which is there, with the hashes of all others, while nothing is being flown
    files.write(_texts(plan))
    write(manifest, files)
    return manifest


def write(manifest: Mapping[str, Any], files: Growing) -> None:
    """Write or replace the manifest in one step.

    Raises:
        OutputError: it cannot be written, or is not as we wrote it.
    """
    files.write({MANIFEST_FILE: to_json(manifest).encode()})


def require_same(plan: Plan, directory: Path) -> None:
    """Refuse to continue a campaign by another one.

    Raises:
        FileError: there is none, or it is damaged.
        InputError: it is another one.
    """
    known = stored_plan(directory)
    differing = [name for name in CampaignSpec.model_fields if getattr(_own(plan), name) != getattr(_own(known), name)]
    grows = plan.spec.sampling != "latin_hypercube" and plan.spec.flights >= known.spec.flights
    if differing == ["flights"] and grows:
        differing = []
    if known.scenario != plan.scenario:
        differing.append("scenario")
    if differing:
        rule = "; more flights may follow, except of a latin_hypercube" if differing == ["flights"] else ""
        raise InputError(
            f"{directory}: --resume needs the same campaign, and its {', '.join(differing)} differs from "
            f"the one there{rule}; choose another --out"
        )


def other_than_flew(manifest: Mapping[str, Any], plan: Plan) -> list[str]:
    """Of `code`, `controller`, `forces`, `versions` and `machine`, those that are not as when a campaign was begun.

    Imports a plug-in controller.
    """
    return [name for name, value in flown_by(plan).items() if manifest.get(name) != value]


def flown_by(plan: Plan) -> dict[str, Any]:
    """What numbers come from besides the campaign's own files."""
    return {
        "code": code_digest(),
        "controller": controller_digest(plan.scenario),
        "forces": [_user_code(force) for force in plan.scenario.forces] or None,
        "versions": versions(),
        "machine": machine(),
    }


@functools.cache
def code_digest() -> str:
    """SHA-256 of everything of ours that numbers come from: code, models, scenarios."""
    return _digest([*(_ROOT / package for package in ("quadsim", "mpc", "scenarios")), models_dir()])


def controller_digest(scenario: Scenario) -> str | None:
    """SHA-256 of the code of a plug-in controller: its module, or the whole package that it is in.

    Raises:
        InputError: the controller cannot be made.
    """
    if not isinstance(scenario.controller, PluginSpec):
        return None
    make_controller(scenario.controller, build_vehicle(scenario), scenario.control_period)
    return _user_code(scenario.controller)


def _user_code(spec: PluginSpec | ForceSpec) -> str | None:
    """SHA-256 of a user's module, or of the whole package that it is in; None without a file."""
    file = getattr(sys.modules[import_plugin(spec).__module__.partition(".")[0]], "__file__", None)
    if file is None:
        return None
    return _digest([Path(file).parent if Path(file).name == "__init__.py" else Path(file)])


def _digest(roots: Iterable[Path]) -> str:
    """SHA-256 of the code, models and scenarios in files and folders."""
    found = hashlib.sha256()
    for root in roots:
        for path in [root] if root.is_file() else sorted(root.rglob("*")):
            if path.suffix in (".py", ".toml", ".xml") and path.is_file():
                found.update(f"{root.name}/{path.relative_to(root).as_posix()}\0".encode())
                found.update(path.read_bytes())
    return f"sha256:{found.hexdigest()}"


def read_manifest(directory: Path) -> dict[str, Any]:
    """`manifest.json` of a campaign.

    Raises:
        FileError: there is none, or it is not one of ours.
    """
    require_inside(directory)
    path = directory / MANIFEST_FILE
    if not path.is_file():
        raise FileError(directory, f"is not a campaign: it has no {MANIFEST_FILE}")
    manifest = read_json(path, _FORM, "a campaign's manifest")
    if manifest["format"] != FORMAT:
        raise FileError(path, "is not a campaign's manifest: it lacks or misstates format")
    return manifest


def is_campaign(directory: Path) -> bool:
    """Whether a path is a campaign's directory."""
    try:
        read_manifest(directory)
    except FileError:
        return False
    return True


def stored_plan(directory: Path) -> Plan:
    """The campaign that a directory holds, from its own files.

    Raises:
        FileError: it is none, or a file is missing or not the one that was flown.
    """
    read_manifest(directory)
    known = _listed(directory)
    for name in (CAMPAIGN_FILE, SCENARIO_FILE, *known):
        path = directory / name
        if not path.is_file() or (name in known and digest_of(path) != known[name]):
            raise FileError(path, "is missing or not the file that was written")
    return load_plan(str(directory / CAMPAIGN_FILE))


def _listed(directory: Path) -> dict[str, str]:
    """The digests of what a finished campaign was and found; none of one that is being flown.

    Raises:
        FileError: its summary is damaged.
    """
    path = directory / SUMMARY_FILE
    summary = read_json(path, {}, "a campaign's summary") if path.exists() else {}
    ours = (CAMPAIGN_FILE, SCENARIO_FILE, FLIGHTS_FILE, TIMES_FILE)
    return {name: digest for name, digest in summary.get("files", {}).items() if name in ours}


def _texts(plan: Plan) -> Mapping[str, bytes]:
    """The campaign as files that need no others."""
    return {CAMPAIGN_FILE: _own(plan).to_toml().encode(), SCENARIO_FILE: plan.scenario.to_toml().encode()}


def _own(plan: Plan) -> CampaignSpec:
    """The campaign's file as its directory has it, with the scenario beside it."""
    return plan.spec.model_copy(update={"scenario": SCENARIO_FILE, "set": {}})
