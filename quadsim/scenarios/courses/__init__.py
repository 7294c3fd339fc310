"""Courses: desired positions and headings, and whether they can be flown."""
