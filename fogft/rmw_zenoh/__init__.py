"""To be written: what is in here, in one sentence."""
