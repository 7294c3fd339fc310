"""The features: each is a folder that can be taken away, with its entry in `features`; see CONTRIBUTING.md.

`arguments` has the types of their commands' arguments, and of those of `quadsim.commands`.
"""
