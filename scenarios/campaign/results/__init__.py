"""The rows of a campaign, one per flight: their table, events, verdicts and storage."""
