"""Conclusions from observations: health, history, backoff, hazards. Pure.

Not here: what to do about them (`fogft.planning`).
"""
