"""Tuning: fields of a scenario searched for, and an answer whose score does not come from the draws that chose it.

In the order in which a tuning passes through them:

- `spec`, `objective`, `plan`: the file; what is to be small; the scenario of each candidate.
- `pilot`: one flight of one candidate; what flies it are the engines of campaigns.
- `ranking`, `search`: which candidate is better; Optuna, which proposes them, and its journal.
- `run`: the search, or what is missing of it, and then the start and the answer on fresh draws.
- `outcome`, `report/`: what came of it, as plain data; tables, figure, plots and page.
"""
