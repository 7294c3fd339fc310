"""Courses: what the vehicle is asked to do, and whether it can."""

from scenarios.courses.build import build_course, build_course_steps, build_reference
from scenarios.courses.report import report

__all__ = ["build_course", "build_course_steps", "build_reference", "report"]
