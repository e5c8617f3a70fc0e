"""Real clouds through SkyPilot's public SDK: a cluster for each replica. See docs/design/sky.md.

Not here: which offer is bought (`fogft.planning`).
"""
