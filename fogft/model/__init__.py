"""The values that all rooms speak of: replicas, placements, membership, what a pool file asks for.

Not here: reading them from files (`fogft.poolfile`), deciding by them (`planning`, `requests`).
"""
