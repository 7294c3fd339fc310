"""Keeping clear of obstacles, and inside corridors and a fence."""
