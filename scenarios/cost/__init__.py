"""What do constraints cost?  Flies and times all that a `quadsim.cost.CostStudy` tells of."""

from scenarios.cost.study import find_study, fly_variations, study_cost

__all__ = ["find_study", "fly_variations", "study_cost"]
