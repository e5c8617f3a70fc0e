"""A pool on disk: every file has one writer.

Not here: what is written (`fogft.pool.manager`).
"""
