"""What a terminal shows: results, tables, verdicts, progress."""
