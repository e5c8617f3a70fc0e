"""Which replicas a pool should have, where, and when one is replaced. Pure.

Not here: observing and applying (`fogft.pool.manager`).
"""
