"""Values used everywhere: replicas, placements, membership, pool specs.

Not here: reading them from files (`fogft.poolfile`), and decisions (`planning`, `requests`).
"""
