"""The pool's certificate authority, its ledger, and bundles that let machines join.

Not here: using a certificate (`fogft.link.zenoh`).
"""
