"""How proxies reach each other: one link a replica, mutual TLS, serialised bytes."""
