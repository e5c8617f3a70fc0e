"""What stops an experiment."""

from __future__ import annotations


class EvaluationError(Exception):
    """An experiment cannot be run, or its run would mean nothing. Says what to do."""
