"""The processes that requests pass through, and their configuration.

Clocks, and moments called `now`, are monotonic seconds here, and in `requests`, `ordering`,
`topics` and `link`.

Not here: who decides (`fogft.requests`, `fogft.ordering`), links (`fogft.link`).
"""
