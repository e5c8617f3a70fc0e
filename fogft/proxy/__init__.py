"""The processes that requests pass through, and their configuration.

Clocks and every `now` are in monotonic seconds here and in `requests`, `ordering`, `topics` and
`link`.

Not here: decisions about requests (`fogft.requests`, `fogft.ordering`), links (`fogft.link`).
"""
