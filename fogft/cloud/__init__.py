"""Clouds that run replicas, and preemption notices. Not here: what to buy (`fogft.planning`)."""
