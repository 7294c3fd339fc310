"""Campaigns, many flights of one scenario: their tables, and what these say with which confidence."""
