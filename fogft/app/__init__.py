"""The composition root: the only place that picks concrete adapters for the ports.

One function for each thing that the command line can ask. They take and return values and
never print; imports stand inside them so that a command loads only what it needs.

Owns: which cloud, which reader of pool files, which store; what a command means.
Not here: text (`fogft.cli`), decisions (`fogft.planning`), the parts themselves.
"""

from fogft.app.chaos import chaos, machine_in
from fogft.app.clouds import CLOUDS, cloud_of, costs_money, make_cloud, make_store, pool_name, pools
from fogft.app.credentials import (
    certificates,
    issue_credentials,
    join,
    revoke_credentials,
    rotate_replicas,
    rotate_robot,
)
from fogft.app.lifecycle import down, order, start
from fogft.app.looking import (
    doctor,
    excluded,
    file_of,
    locations,
    logs,
    manager_alive,
    refresh,
    slots,
    status,
    tail,
)
from fogft.app.parts import (
    examples,
    init,
    run_gateway,
    run_manager,
    run_proxy,
    run_rendezvous,
    run_server,
)
from fogft.app.planning import plan
from fogft.app.simulate import check_plot, draw, simulate
from fogft.app.sweeping import clouds_to_sweep, end_unowned, sweep
from fogft.app.wishes import drain, exclude, include, scale

__all__ = [
    "CLOUDS",
    "certificates",
    "chaos",
    "check_plot",
    "cloud_of",
    "clouds_to_sweep",
    "costs_money",
    "doctor",
    "down",
    "drain",
    "draw",
    "end_unowned",
    "examples",
    "exclude",
    "excluded",
    "file_of",
    "include",
    "init",
    "issue_credentials",
    "join",
    "locations",
    "logs",
    "machine_in",
    "make_cloud",
    "make_store",
    "manager_alive",
    "order",
    "plan",
    "pool_name",
    "pools",
    "refresh",
    "revoke_credentials",
    "rotate_replicas",
    "rotate_robot",
    "run_gateway",
    "run_manager",
    "run_proxy",
    "run_rendezvous",
    "run_server",
    "scale",
    "simulate",
    "slots",
    "start",
    "status",
    "sweep",
    "tail",
]
