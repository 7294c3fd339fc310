"""Courses: what the vehicle is asked to do, and whether it can."""
