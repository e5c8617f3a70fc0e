"""The life of a request: hedging, first success, votes, fallback, admission. Pure.

Each `now` is in seconds on one monotonic clock, the caller's.

Not here: sending (`fogft.proxy.robot`).
"""
