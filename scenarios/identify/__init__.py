"""A vehicle file from flight logs: reading and checking them, the fit with its gates, and the file and page it gives."""
