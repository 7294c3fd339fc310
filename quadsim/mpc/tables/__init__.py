"""The tables `[controller]` of scenario files: their fields, limits and messages."""
