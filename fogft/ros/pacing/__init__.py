"""Responses that leave no faster than their clients take them.

Not here: sending them (`fogft.ros.entities`, `fogft.rmw_zenoh`).
"""
