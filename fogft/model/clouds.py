"""The clouds that a pool file can name, by SkyPilot's names for them.

Kept here so that reading a pool file needs no SkyPilot; `tests/sky/test_installed.py` holds
the list to the installed one's.
"""

from __future__ import annotations

VM_CLOUDS = (
    *("aws", "azure", "cudo", "do", "fluidstack", "gcp", "hyperbolic", "ibm", "lambda", "mithril"),
    *("nebius", "oci", "paperspace", "primeintellect", "runpod", "scp", "seeweb", "shadeform"),
    *("vast", "verda", "vsphere", "yotta"),
)
# SkyPilot can use them, but they have no machines of their own to replicate on.
NO_VM_CLOUDS = ("k8s", "kubernetes", "slurm", "ssh")
