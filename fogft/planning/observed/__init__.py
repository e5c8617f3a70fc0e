"""Conclusions from observations: health, history, backoff, expiring prices. Pure.

Not here: what to do about them (`fogft.planning`).
"""
