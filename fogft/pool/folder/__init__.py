"""A pool on disk: who writes which file, see `PoolPaths`.

Not here: what is written (`fogft.pool.manager`).
"""
