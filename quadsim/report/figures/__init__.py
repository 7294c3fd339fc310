"""Figures on paper, as PNG and SVG.

The same numbers give the same bytes: no date, no random identifiers, no global state of matplotlib.
"""
