"""A pool's files; `PoolPaths` says who writes which. Not here: why (`fogft.pool.manager`)."""
