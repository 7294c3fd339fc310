"""Campaigns, many flights of one scenario: flown, kept, and what they say with which confidence."""
