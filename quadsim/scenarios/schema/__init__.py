"""The scenario file, checked field by field; one module per table."""
