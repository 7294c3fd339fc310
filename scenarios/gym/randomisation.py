"""What varies from episode to episode: the draws of a campaign's `[[vary]]`, on a scenario of the user's choice."""

from __future__ import annotations

import tomllib
from typing import Any

from scenarios.campaign.plan import Plan, read_campaign
from scenarios.campaign.plan import make_plan as plan_of
from scenarios.loading import parse_scenario
from scenarios.schema.bases import merge
from scenarios.schema.scenario import Scenario


def make_plan(scenario: Scenario, campaign: str) -> Plan:
    """The draws of a campaign, its name or file, with its `[set]`, for a scenario that need not be its own.

    Raises:
        InputError: there is no such campaign, or what it varies cannot be flown with this scenario.
    """
    data = read_campaign(campaign)
    if data.get("set"):
        merged = merge(tomllib.loads(scenario.to_toml()), data["set"])
        scenario = parse_scenario(merged, source=f"{scenario.name}, as {campaign} sets it")
    plan: dict[str, Any] = {key: data[key] for key in ("name", "flights", "seed", "sampling", "vary") if key in data}
    return plan_of(scenario, plan)
