"""Counters of proxies, the page that Prometheus reads, and spans for OpenTelemetry.

Not here: the manager's metrics (`fogft.pool.manager.tally`).
"""
