"""Counters of proxies, and the page that Prometheus reads.

Not here: the manager's metrics (`fogft.pool.manager.tally`).
"""
