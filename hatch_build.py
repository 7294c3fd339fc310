"""Build hook: compile quadsim's C into wheels and, for editable installs, beside its sources."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

_SPEC = importlib.util.spec_from_file_location("core_build", Path(__file__).parent / "quadsim" / "core" / "build.py")
assert _SPEC is not None
assert _SPEC.loader is not None
core_build = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(core_build)


class CoreHook(BuildHookInterface):
    """Adds the library and the platform's tag; see `quadsim/core/build.py` for the compiler."""

    def dependencies(self) -> list[str]:
        """See hatchling; a C compiler as a wheel, unless the system's is used."""
        return core_build.requirements()

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """See hatchling."""
        core_build.compile_library(Path(self.root))
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{core_build.platform_tag()}"
        build_data["artifacts"].append(f"/{core_build.LIBRARY}")  # which git ignores
