"""The pool file: read it, judge it, compare two. Pure but for `file` and `workspace`.

Not here: the values that come of it (`fogft.model`).
"""
