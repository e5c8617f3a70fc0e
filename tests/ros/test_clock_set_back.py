"""The system clock is set back under Fast DDS that waits by it, as the wheels' does."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from tests.fakes.waiting import wait_for
from tests.needs import needs
from tests.soak.clocks import Clocks

pytestmark = [pytest.mark.ros]

LEASE_S = 6  # six announcements: one that is held up for seconds is not forgotten
PROFILE_VARIABLES = ("FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_DEFAULT_PROFILES_FILE")
PROFILE = f"""<?xml version="1.0" encoding="UTF-8" ?>
<profiles xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <participant profile_name="short_lease" is_default_profile="true"><rtps><builtin>
    <discovery_config>
      <leaseDuration><sec>{LEASE_S}</sec></leaseDuration>
      <leaseAnnouncement><sec>1</sec></leaseAnnouncement>
    </discovery_config>
  </builtin></rtps></participant>
</profiles>
"""
STANDBY = """
import sys, time
from fogft.ros.joining import EarlyJoin
from tests.fakes.waiting import wait_for
early = EarlyJoin("_standby", int(sys.argv[1]))
print("joined", flush=True)
while True:
    time.sleep(0.1)
    early.look()
"""


@needs("build", "fastdds")
def test_a_standby_whose_clock_is_set_back_stays_known(
    ros_domain: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It goes on to send signs of life, although its timers wait by that clock."""
    import rclpy
    from rclpy.context import Context

    for name in ("LD_PRELOAD", "FOGFT_CLOCKS"):
        monkeypatch.setenv(name, "")  # `Clocks` sets them: put them back afterwards
    clocks = Clocks(tmp_path)
    profile = tmp_path / "profile.xml"
    profile.write_text(PROFILE)
    profiles = {name: str(profile) for name in PROFILE_VARIABLES}
    standby = subprocess.Popen(
        [sys.executable, "-c", STANDBY, str(ros_domain)],
        env={**os.environ, **profiles}, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    context = Context()
    rclpy.init(context=context, domain_id=ros_domain)
    node = rclpy.create_node("watcher", context=context)
    try:
        assert standby.stdout is not None
        assert standby.stdout.readline() == "joined\n"
        wait_for(lambda: "_standby" in node.get_node_names(), 20.0, pause_s=0.05)
        time.sleep(1.5)  # each announcement is by a timer now
        clocks.set([standby.pid], -3600)
        looks = []
        for _ in range(15 * LEASE_S):
            time.sleep(0.1)
            looks.append("_standby" in node.get_node_names())
        assert all(looks)
    finally:
        node.destroy_node()
        context.try_shutdown()
        standby.kill()
        standby.communicate()
