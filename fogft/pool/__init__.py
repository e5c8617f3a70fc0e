"""A pool's life: the manager, the commands, its folder and its credentials.

Not here: what to launch or end (`fogft.planning`), requests (`fogft.proxy`).
"""
