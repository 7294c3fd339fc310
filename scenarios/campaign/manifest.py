"""A campaign's directory: what says what is flown, with what, and how far it got."""

from __future__ import annotations

import functools
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from quadsim.assets import models_dir
from quadsim.errors import FileError, InputError
from quadsim.rundir import write_atomically, write_json
from scenarios.campaign.plan import Plan, load_plan
from scenarios.campaign.spec import CampaignSpec
from scenarios.runner import machine, versions

MANIFEST_FILE: Final = "manifest.json"
CAMPAIGN_FILE: Final = "campaign.toml"
SCENARIO_FILE: Final = "scenario.toml"
FORMAT: Final = "quadsim campaign"
_KEYS: Final = {"format": str, "name": str, "status": str, "flights": int, "flown": int, "sessions": list}
_ROOT: Final = Path(__file__).resolve().parents[2]
_PACKAGES: Final = ("quadsim", "mpc", "scenarios")


def begin(plan: Plan, directory: Path, sessions: Sequence[Mapping[str, Any]] = ()) -> dict[str, Any]:
    """Write the files that define a campaign; its manifest comes last.

    Args:
        plan: the campaign.
        directory: it is there already.
        sessions: what was flown of it before.

    Returns:
        The manifest.

    Raises:
        OutputError: they cannot be written.
    """
    texts = _texts(plan)
    for name, text in texts.items():
        write_atomically(directory / name, text)
    manifest: dict[str, Any] = {
        "format": FORMAT,
        "name": plan.spec.name,
        "description": plan.spec.description,
        "scenario": plan.scenario.name,
        "status": "running",
        "flights": plan.spec.flights,
        "flown": 0,
        "files": {name: _digest(text.encode()) for name, text in texts.items()},
        "code": code_digest(),
        "versions": versions(),
        "machine": machine(),
        "sessions": [*sessions],
    }
    write(manifest, directory)
    return manifest


def write(manifest: Mapping[str, Any], directory: Path) -> None:
    """Write or replace the manifest in one step.

    Raises:
        OutputError: it cannot be written.
    """
    write_json(directory / MANIFEST_FILE, manifest)


def require_same(plan: Plan, directory: Path) -> dict[str, Any]:
    """The manifest of a campaign that is to go on.

    Raises:
        FileError: there is none, or it is damaged.
        InputError: it is another campaign, or other code would go on with it.
    """
    manifest = read_manifest(directory)
    known = stored_plan(directory)
    differing = [name for name in CampaignSpec.model_fields if getattr(_own(plan), name) != getattr(known.spec, name)]
    grows = plan.spec.sampling != "latin_hypercube" and plan.spec.flights >= known.spec.flights
    if differing == ["flights"] and grows:
        differing = []
    if known.scenario != plan.scenario.model_copy(update={"name": known.scenario.name}):
        differing.append("scenario")
    if differing:
        rule = "; more flights may follow, except of a latin_hypercube" if differing == ["flights"] else ""
        raise InputError(
            f"{directory}: --resume goes on with the same campaign alone, and its {', '.join(differing)} differs from "
            f"the one there{rule}; choose another --out"
        )
    found = {"code": code_digest(), "versions": versions()}
    differing = [name for name, value in found.items() if manifest.get(name) != value]
    if differing:
        raise InputError(
            f"{directory}: --resume goes on with the same code alone, and {' and '.join(differing)} are not what flew "
            "the first flights: half of the numbers would be of another program; choose another --out"
        )
    return manifest


def read_manifest(directory: Path) -> dict[str, Any]:
    """`manifest.json` of a campaign.

    Raises:
        FileError: there is none, or it is not one of ours.
    """
    path = directory / MANIFEST_FILE
    if not path.is_file():
        raise FileError(directory, f"is not a campaign: it has no {MANIFEST_FILE}")
    try:
        manifest = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise FileError(path, f"is not a campaign's manifest ({error})") from error
    wrong = [
        name
        for name, kind in _KEYS.items()
        if not isinstance(manifest, dict) or not isinstance(manifest.get(name), kind)
    ]
    if wrong or manifest["format"] != FORMAT:
        raise FileError(path, f"is not a campaign's manifest: it lacks or misstates {', '.join(wrong or ['format'])}")
    return dict(manifest)


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
    manifest = read_manifest(directory)
    for name in (CAMPAIGN_FILE, SCENARIO_FILE):
        path = directory / name
        if not path.is_file() or _digest(path.read_bytes()) != manifest["files"].get(name):
            raise FileError(path, "is missing or not the file that was flown")
    return load_plan(str(directory / CAMPAIGN_FILE))


@functools.cache
def code_digest() -> str:
    """SHA-256 of everything of ours that numbers come from: code, models, scenarios."""
    digest = hashlib.sha256()
    folders = [*(_ROOT / package for package in _PACKAGES), models_dir()]
    for folder in folders:
        for path in sorted(folder.rglob("*")):
            if path.suffix in (".py", ".toml", ".xml") and path.is_file():
                digest.update(f"{folder.name}/{path.relative_to(folder).as_posix()}\0".encode())
                digest.update(path.read_bytes())
    return f"sha256:{digest.hexdigest()}"


def _texts(plan: Plan) -> Mapping[str, str]:
    """The campaign as files that need no others."""
    return {CAMPAIGN_FILE: _own(plan).to_toml(), SCENARIO_FILE: plan.scenario.to_toml()}


def _own(plan: Plan) -> CampaignSpec:
    """The campaign's file as its directory has it, with the scenario beside it."""
    return plan.spec.model_copy(update={"scenario": SCENARIO_FILE, "set": {}})


def _digest(content: bytes) -> str:
    return "sha256:" + hashlib.sha256(content).hexdigest()
