"""Whole pools under simulated time: the real manager against recorded or generated spot markets.

Decided in docs/design/simulation.md.
"""
