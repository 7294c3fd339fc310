"""The scenario file: what it may say, checked field by field; one module per table."""

from scenarios.spec.controller import ConstrainedSpec, UnconstrainedSpec
from scenarios.spec.course import WindowSpec
from scenarios.spec.optimisation import ANGLES, LARGEST_HORIZON
from scenarios.spec.scenario import MOST_STEPS, Group, Scenario, Verdict

__all__ = [
    "ANGLES",
    "LARGEST_HORIZON",
    "MOST_STEPS",
    "ConstrainedSpec",
    "Group",
    "Scenario",
    "UnconstrainedSpec",
    "Verdict",
    "WindowSpec",
]
