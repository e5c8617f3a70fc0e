"""Pools: manager, commands, folder, credentials. Not here: what to launch (`fogft.planning`)."""
