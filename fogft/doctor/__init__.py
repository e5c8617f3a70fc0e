"""Checks of why a pool may not work on this machine, with a remedy for each.

A check yields findings and changes nothing. Not here: how they are shown (`fogft.cli.doctor`).
"""
