"""Campaigns: many flights of one scenario, with statistics and their confidence.

`campaign_file` and `plan` make each flight's scenario and row; `campaign` flies them all, or one again; `sweep` flies
every combination of values; `rows`, `events` and `store` hold what was flown; `statistics`, `paired` and
`campaign_report` are what a reader sees; `reaudit` judges a table by other tolerances.
"""
