"""The scenario file: what it may say, checked field by field; one module per table."""
