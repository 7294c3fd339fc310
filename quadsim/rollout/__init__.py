"""One flight, from its scenario to its record, and many: rollout, `Flight`, audit from tables, remedies.

Read first `rollout` (the flight), then `flown` (what came of it).
"""
