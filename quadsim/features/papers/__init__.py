"""Numbers of papers, one TOML file per paper, and their reproduction by flight."""
