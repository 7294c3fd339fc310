"""Build hook: compile the core into the package; without a compiler the package is pure Python, and PIQP flies."""

from __future__ import annotations

import importlib.util
import os
import subprocess
import sysconfig
from pathlib import Path
from typing import Any, Final

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

CORE: Final = "mpc/core"


class CoreHook(BuildHookInterface):
    """Adds the library and the platform's tag to wheels.

    `QUADSIM_NEED_CORE=1` makes a core that cannot be compiled an error, `QUADSIM_NO_CORE=1` compiles none.
    """

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """See hatchling; an editable install loads the library from the source tree."""
        if self.target_name != "wheel" or os.environ.get("QUADSIM_NO_CORE"):
            return
        folder = Path(self.root) / CORE
        spec = importlib.util.spec_from_file_location("core_build", folder / "build.py")
        assert spec is not None
        assert spec.loader is not None
        tool = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(tool)
        try:
            tool.build(folder)
        except (FileNotFoundError, subprocess.CalledProcessError) as error:
            if os.environ.get("QUADSIM_NEED_CORE"):
                raise
            reason = getattr(error, "stderr", "") or error
            self.app.display_warning(f"quadsim: the core is not compiled, PIQP flies in its place: {reason}")
            return
        build_data["pure_python"] = False
        build_data["tag"] = f"py3-none-{sysconfig.get_platform().replace('-', '_').replace('.', '_')}"
        build_data["artifacts"].append(f"/{CORE}/{tool.NAME}")  # which git ignores
