"""Replicas as real processes on this machine, in named regions. See docs/design/local-cloud.md."""

from fogft.cloud.local.cloud import LocalCloud

__all__ = ["LocalCloud"]
