"""What `up`, `scale`, `join`, `sweep`, ... do to a pool. Not here: their text (`fogft.cli`)."""
