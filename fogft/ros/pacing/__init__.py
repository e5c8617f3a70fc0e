"""Pacing of responses, so that clients' queues do not overflow.

Not here: sending them (`fogft.ros.entities`, `fogft.rmw_zenoh`).
"""
