"""Pools: the manager, the commands, the folder and the credentials.

Not here: what to launch or end (`fogft.planning`), requests (`fogft.proxy`).
"""
