"""A campaign as tables, text, figure, plots and pages."""
