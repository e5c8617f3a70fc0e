"""A pool on disk: who writes which file, see `PoolPaths`."""
