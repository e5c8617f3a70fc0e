"""Keep a pool as its file says: the manager, its state on disk and its credentials."""
