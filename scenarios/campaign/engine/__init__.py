"""Who flies the flights of a campaign: processes on this machine, or a cluster."""
