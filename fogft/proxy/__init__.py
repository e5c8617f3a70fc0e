"""The client proxy (robot) and the server proxy (replica)."""
