"""The manager of one pool: observe, plan, apply. Not here: what to launch (`fogft.planning`)."""
