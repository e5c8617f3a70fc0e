"""Checks of why a pool may not work here. Not here: how they are shown (`fogft.cli.doctor`)."""
