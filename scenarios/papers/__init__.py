"""Numbers that papers publish, one TOML file per paper, and their reproduction by flight."""
