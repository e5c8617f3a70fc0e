"""A pool's CA, its ledger, and join bundles. Not here: using a certificate (`fogft.link.zenoh`)."""
