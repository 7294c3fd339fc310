"""The forms of a QP: the same optimal control problem condensed to its inputs, or with all states as variables."""
