"""Counters of proxies, Prometheus metrics, and OpenTelemetry spans.

Not here: the manager's metrics (`fogft.pool.manager.tally`).
"""
