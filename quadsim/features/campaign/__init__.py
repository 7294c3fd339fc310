"""Campaigns: many flights of one scenario, with statistics and their confidence.

`campaign_file` and `plan` make each flight's scenario and row; `campaign` flies them all, or one again; `rows`,
`events` and `store` hold them; `statistics`, `paired` and `campaign_report` are what a reader sees.
"""
