"""Stateful services: ordering of requests, snapshots, and catching up. Pure.

Not here: sending (`fogft.proxy`).
"""
