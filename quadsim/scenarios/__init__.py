"""From a scenario file to objects: its tables, its courses, and the parts that it names.

Read first `loading` (a name or path to a `schema` scenario), then `assembly` (its plant, controller and course).
The files themselves are in `scenarios/`, in a wheel `quadsim/library/`.
"""
