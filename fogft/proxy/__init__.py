"""The processes that requests pass through, and their configuration.

Not here: who decides (`fogft.requests`, `fogft.ordering`), links (`fogft.link`).
"""
