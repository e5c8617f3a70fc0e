"""A state folder of its own for each test."""

from tests.cli.conftest import home

__all__ = ["home"]
