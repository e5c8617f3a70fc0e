"""A pool on disk; `PoolPaths` says who writes what. Not here: why (`fogft.pool.manager`)."""
