"""Methods that stand for functions of higher floors: `scenario.fly()` is `quadsim.fly(scenario)`.

Imports go down the floors alone, so a value cannot import what is built on it.  A package that hands out public names
is imported before any module in it, and puts its functions here; the value's method calls them.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

fly_scenario: Callable[..., Any]
"""`Scenario.fly`; `quadsim/__init__.py` puts `quadsim.fly` here."""
scenario_as_html: Callable[[Any], str]
"""How a notebook shows a scenario; `quadsim/__init__.py` puts `quadsim.scenario_html` here."""
condensed_form: Callable[[Any], Any]
"""`Problem.condensed`; `quadsim/mpc/__init__.py` puts `quadsim.mpc.Condensed.of` here."""
nonlinear_mpc: Callable[..., Any]
"""For `Nonlinear.law`, the table that it reads; `quadsim/mpc/__init__.py` puts `quadsim.mpc.NonlinearMPC` here."""
robust_preparation: Callable[..., Any]
"""For `Robust.law`, likewise; `quadsim/mpc/__init__.py` puts `quadsim.mpc.RobustPreparation` here."""
