"""Campaigns: many flights of one scenario, and what they show with which confidence.

In the order in which a campaign passes through them:

- `spec`, `draws`, `plan`: the file; the values drawn for each flight; the scenario of each flight.
- `pilot`: one flight and its row; `scenarios.many` flies them all, by processes on this machine or a cluster.
- `results/`, `manifest`: rows, events and verdicts; the directory, and the code that the numbers come from.
- `run`: a campaign, or what is missing of it; `sweep` and `replay`: every combination of values, one flight again.
- `statistics/`, `report/`: estimates, comparisons, requirements; tables, figures and page.
"""
