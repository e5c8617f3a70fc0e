"""Checks for why a pool may not work here. Not here: their display (`fogft.cli.doctor`)."""
