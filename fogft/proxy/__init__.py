"""The processes that requests pass through, and their configuration.

Clocks, and moments called `now`, are monotonic seconds here, and in `requests`, `ordering`,
`topics` and `link`.
"""
