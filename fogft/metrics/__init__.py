"""Metrics and spans of proxies. Not here: the manager's metrics (`fogft.pool.manager.tally`)."""
