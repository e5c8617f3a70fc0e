"""Whole pools under simulated time: the real manager against recorded or generated spot markets.

Not here: the manager's decisions (`fogft.planning`). See docs/design/simulation.md.
"""
