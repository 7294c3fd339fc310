"""A campaign's directory: its plan, code and progress."""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from mpc.core.library import why_missing
from quadsim.assets import models_dir
from quadsim.errors import FileError, InputError
from quadsim.flight.summary import read_json, require_inside
from quadsim.outputs import SUMMARY_FILE, Growing, digest_of, to_json
from scenarios.campaign.plan import Plan, load_plan
from scenarios.campaign.results.store import FLIGHTS_FILE, TIMES_FILE
from scenarios.campaign.spec import CampaignSpec
from scenarios.machine import machine, versions
from scenarios.plugin import Plugin, PluginForce, import_plugin

MANIFEST_FILE: Final = "manifest.json"
CAMPAIGN_FILE: Final = "campaign.toml"
SCENARIO_FILE: Final = "scenario.toml"
FORMAT: Final = "quadsim campaign"
_FORM: Final = {"format": str, "name": str, "status": str, "flights": int, "flown": int, "sessions": list}
_ROOT: Final = Path(__file__).resolve().parents[2]


def start(plan: Plan, files: Growing, session: Mapping[str, Any], *, flying: bool) -> dict[str, Any]:
    """The manifest of a campaign that begins, or is resumed, with the files that define it, itself the last of them.

    Raises:
        FileError: it is damaged.
        InputError: something has to be flown, and other code would fly it.
        OutputError: they cannot be written.
    """
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
    if is_campaign(files.path):
        known = read_manifest(files.path)
        differing = [name for name in other_than_flew(known, plan) if name != "machine"]
        if flying and differing:
            raise InputError(
                f"{files.path}: --resume needs the same code, and this one differs from what flew the first flights "
                f"({', '.join(differing)}): half of the numbers would be another program's; choose another --out"
            )
        manifest = {**known, "status": "running", "flights": plan.spec.flights}
        files.remove([SUMMARY_FILE])  # which is there, with the hashes of all others, while nothing is being flown
    manifest["sessions"].append(session)
    own = {CAMPAIGN_FILE: _own(plan).to_toml(), SCENARIO_FILE: plan.scenario.to_toml()}  # files that need no others
    files.write({name: text.encode() for name, text in own.items()})
    write(manifest, files)
    return manifest


def write(manifest: Mapping[str, Any], files: Growing) -> None:
    """Write or replace the manifest in one step."""
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
    """Of what `flown_by` states, that which is not as when a campaign was begun."""
    return [name for name, value in flown_by(plan).items() if manifest.get(name) != value]


def flown_by(plan: Plan) -> dict[str, Any]:
    """What numbers come from besides the campaign's own files; imports code of the user."""
    controller = plan.scenario.controller
    return {
        "code": code_digest(),
        "controller": _user_code(controller) if isinstance(controller, Plugin) else None,
        "forces": [_user_code(force) for force in plan.scenario.forces] or None,
        "versions": versions(),
        "machine": machine(),
    }


@functools.cache
def code_digest() -> str:
    """SHA-256 of everything of ours that numbers come from: code, models, scenarios, and whether there is a core."""
    code = _digest([*(_ROOT / package for package in ("quadsim", "mpc", "scenarios")), models_dir()])
    return code if why_missing() is None else f"{code}, without the core"


def _user_code(spec: Plugin | PluginForce) -> str | None:
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
            if path.suffix in (".py", ".c", ".h", ".toml", ".xml") and path.is_file():
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
    path = directory / SUMMARY_FILE  # of a finished campaign
    listed = read_json(path, {}, "a campaign's summary").get("files", {}) if path.exists() else {}
    for name in (CAMPAIGN_FILE, SCENARIO_FILE, *(name for name in (FLIGHTS_FILE, TIMES_FILE) if name in listed)):
        path = directory / name
        if not path.is_file() or (name in listed and digest_of(path) != listed[name]):
            raise FileError(path, "is missing or not the file that was written")
    return load_plan(str(directory / CAMPAIGN_FILE))


def _own(plan: Plan) -> CampaignSpec:
    """The campaign's file as its directory has it, with the scenario beside it."""
    return plan.spec.model_copy(update={"scenario": SCENARIO_FILE, "set": {}})
