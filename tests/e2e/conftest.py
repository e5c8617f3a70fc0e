"""Pools for the end-to-end tests: each in a folder and a ROS domain of its own."""

from __future__ import annotations

import pytest

from tests.e2e.pool import Pool


@pytest.fixture
def pool(tmp_path, ros_domain):
    """A pool that is written but not up; ended by force afterwards."""
    made = Pool(tmp_path, ros_domain)
    made.write()
    yield made
    made.close()
