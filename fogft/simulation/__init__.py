"""Simulation of pools: the real manager in recorded or generated spot markets.

Not here: the manager's decisions (`fogft.planning`). See docs/design/simulation.md.
"""
