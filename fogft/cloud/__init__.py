"""Where replicas run: one port, several clouds behind it."""
