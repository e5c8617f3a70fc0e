"""Where replicas run, and preemption notices. Not here: what is bought (`fogft.planning`)."""
