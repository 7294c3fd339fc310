"""Zoomable plots for a page that works offline."""
