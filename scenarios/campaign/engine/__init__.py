"""The workers of a campaign: processes on this machine, or a cluster."""
