"""The manager of one pool: observe, plan, apply, once a second.

Not here: what to launch or end (`fogft.planning`).
"""
