"""What observations mean: health, history, backoff, prices that expire. Pure.

Not here: what to do about them (`fogft.planning`).
"""
