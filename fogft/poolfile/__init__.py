"""The pool file: reading, checking and comparing. Pure but for `file` and `config_file`.

Not here: the values that come of it (`fogft.model`).
"""
