"""The rows of a campaign, one per flight: their table, their events and verdicts, and how they are kept."""
