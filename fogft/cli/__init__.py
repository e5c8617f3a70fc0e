"""The command line. Not here: what a command does (`fogft.pool.commands`)."""
