"""A local machine's process: ``python -m fogft.cloud.local.machine FOLDER``.

It boots, runs `setup`, serves and ends: when told to (``end.json``, ``notice.json``, a signal) or
with the server proxy. Single-threaded: the kernel ties children to the thread that started them.
"""

import contextlib
import hashlib
import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from fogft import child, disk, logfile
from fogft.cloud.local import faults, processes
from fogft.cloud.local.ending import sweep_shared_memory
from fogft.cloud.local.folder import END, LINK, LOCK, NOTICE, STATE, MachineFolder, Record, State
from fogft.errors import FogftError, StateError, told
from fogft.model.plain import to_plain
from fogft.model.reason import Cause, Reason
from fogft.model.replica import MachinePhase
from fogft.process import ending_signals, start_log
from fogft.reason_words import words
from fogft.ros.environment import child_environment
from fogft.ros.reservations import Reservation, own_domain, reserve_domain, reserve_port

if TYPE_CHECKING:
    from fogft.cloud.local.relay import Relay

log = logging.getLogger("fogft.machine")

TICK_S = 0.05
FOLDER_PATIENCE_S = 5.0  # somebody removed it: nobody can list or end this machine any more


class _Ended(Exception):
    """The machine has to end; says why."""


class _Failed(Exception):
    """The machine will never run; says why."""

    def __init__(self, cause: Cause, said: str) -> None:
        super().__init__(said)
        self.reason = Reason(cause, words=said)


def main(arguments: list[str]) -> int:
    """Run a machine until it ends."""
    folder = MachineFolder.at(Path(arguments[0]).absolute())
    if folder is None or os.environ.get(processes.MACHINE) != str(folder.id):
        print("error: this is started by the local cloud only", file=sys.stderr)
        return 2
    if not folder.exists:
        return 0  # it was terminated before it started
    start_log()
    lock = disk.Lock(folder.path / LOCK)
    try:
        begins = lock.acquire(wait=False) and folder.due(END) != 0
    except FileNotFoundError:  # it has just been terminated
        return 0
    if begins:
        Machine(folder, folder.record()).run()
    return 0


class Machine:
    """One machine's life. The caller holds its lock."""

    def __init__(self, folder: MachineFolder, record: Record) -> None:
        self._folder = folder
        self._record = record
        self._guard = 0
        self._statuses: dict[int, int] = {}  # exit codes of children that have ended
        self._signal = 0
        self._next_tick = 0.0
        self._log_checked = 0.0
        self._seen_at = time.monotonic()
        self._link = disk.Watched(folder.path / LINK)
        self._faults = faults.LinkFaults()
        self._relay: Relay | None = None

    def run(self) -> None:
        """Run the machine to its end. Leaves a FAILED state if it could not run."""
        self._say(State(MachinePhase.PROVISIONING, progress="booting"))
        self._guard = processes.start(lambda: self._end_the_rest(set()))
        for number in ending_signals():
            signal.signal(number, self._on_signal)
        try:
            workdir = self._boot()
            self._set_up(workdir)
            self._serve(workdir)
        except _Ended as ended:
            log.info("machine_ended replica=%s reason=%r", self._folder.id.short, str(ended))
        except _Failed as failed:
            reason = words(failed.reason)
            log.error("machine_failed replica=%s reason=%r", self._folder.id.short, reason)
            self._say(State(MachinePhase.FAILED, failure=failed.reason))
        except FogftError as error:
            log.error("machine_failed replica=%s reason=%r", self._folder.id.short, error.message)
            failure = Reason(Cause.ERROR, words=told(error))
            self._say(State(MachinePhase.FAILED, failure=failure))
        finally:
            self._end_the_rest({self._guard})
            if self._relay is not None:
                self._relay.close()

    def _end_the_rest(self, spare: set[int]) -> None:
        processes.end_machine(str(self._folder.id), spare=spare)
        sweep_shared_memory()

    def _boot(self) -> Path:
        """Wait, then return the folder for `setup` and `run`: `workdir`, used in place."""
        id, placement = self._folder.id, self._record.order.placement
        log.info("machine_boots replica=%s zone=%s", id.short, placement.location)
        booted_at = time.monotonic() + self._record.zone.boot_s
        self._wait(lambda: time.monotonic() >= booted_at)
        wanted = self._record.order.task.get("workdir")
        if wanted is None:
            workdir = self._folder.path / "workdir"
            workdir.mkdir(exist_ok=True)
            return workdir
        if not isinstance(wanted, str) or not Path(wanted).is_dir():
            raise _Failed(Cause.SETUP, f"`workdir` is not a folder on this computer: {wanted}")
        return Path(wanted)

    def _set_up(self, workdir: Path) -> None:
        for key in ("file_mounts", "volumes"):
            if self._record.order.task.get(key):
                log.warning("task_key_ignored key=%s reason='local cloud'", key)
        command = self._record.order.task.get("setup")
        if not command:
            return
        # One `setup` at a time per folder: machines share it, and two builds would clash.
        name = hashlib.sha256(str(workdir.resolve()).encode()).hexdigest()[:16]
        turn = disk.Lock(self._folder.path.parents[1] / f"setup-{name}.lock")
        waits = "waiting for another machine's setup"
        self._say(State(MachinePhase.PROVISIONING, progress=waits, setting_up=True))
        self._wait(lambda: turn.acquire(wait=False))
        self._say(State(MachinePhase.PROVISIONING, progress="setup", setting_up=True))
        log.info("setup_started command=%r", command)
        begin = logfile.size(self._folder.log)
        environ = _setup_environment(self._record.order.task)
        pid = self._spawn(["bash", "-c", str(command)], workdir, environ)
        self._wait(lambda: pid in self._statuses)
        turn.release()
        code = self._statuses.pop(pid)
        if code:
            tail = logfile.tail(self._folder.log, begin)
            raise _Failed(Cause.SETUP, f"{child.how_it_ended(code)}\n{tail}".rstrip())
        log.info("setup_done")

    # -- serve ------------------------------------------------------------------------------

    def _serve(self, workdir: Path) -> None:
        domain = reserve_domain({own_domain()})  # not the launcher's own domain
        port = reserve_port()
        if domain is None or port is None:
            missing = "ROS domain" if domain is None else "port"
            raise _Failed(Cause.ERROR, f"no {missing} is free here")
        begin = logfile.size(self._folder.log)
        pid = self._start_server(workdir, domain, port)
        endpoint = f"127.0.0.1:{port.number}"
        if self._record.zone.relay:
            from fogft.cloud.local.relay import Relay  # late: it loads asyncio

            self._relay = Relay(("127.0.0.1", port.number), begins=b"\x16\x03")  # a TLS handshake
            endpoint = self._relay.endpoint
        running = State(
            MachinePhase.RUNNING,
            endpoint=endpoint,
            pids={"machine": os.getpid(), "guard": self._guard, "serve": pid},
            domain_id=domain.number,
            set_up_at=time.time(),
        )
        self._say(running)
        log.info("machine_runs endpoint=%s domain=%d serve_pid=%d", endpoint, domain.number, pid)
        self._wait(lambda: pid in self._statuses)
        code = self._statuses.pop(pid)
        if code > 0 and self._relay is not None and not self._relay.reached:
            tail = logfile.tail(self._folder.log, begin)
            raise _Failed(Cause.ERROR, f"serve {child.how_it_ended(code)}\n{tail}".rstrip())
        raise _Ended(f"serve {child.how_it_ended(code)}")

    def _start_server(self, workdir: Path, domain: Reservation, port: Reservation) -> int:
        folder = self._folder.path
        command = [
            *self._record.serve,
            *("--config", str(folder / "replica.yaml")),
            *("--listen", f"127.0.0.1:{port.number}"),
            *("--domain-id", str(domain.number)),
            *("--workdir", str(workdir)),
            *("--notice-file", str(folder / NOTICE)),
        ]
        environ = _server_environment(self._record.order.task, domain.number)
        return self._spawn(_sourced(command, workdir), folder, environ)

    def _spawn(self, command: list[str], workdir: Path, environ: Mapping[str, str]) -> int:
        try:
            process = subprocess.Popen(
                child.tied(command), cwd=workdir, env=environ, stdin=subprocess.DEVNULL
            )
        except OSError as error:
            raise _Failed(Cause.ERROR, f"`{command[0]}` cannot be started: {error}") from error
        process.returncode = 0  # we wait for all children ourselves: see `_reap`
        return process.pid

    # -- the loop ---------------------------------------------------------------------------

    def _wait(self, done: Callable[[], object]) -> None:
        """Run timers and relay until `done()`. Raises `_Ended`: the machine has to end first."""
        while True:
            now = time.monotonic()
            if now >= self._next_tick:
                self._next_tick = now + TICK_S
                self._tick(now)
                if done():
                    return
            rest_s = max(0.0, self._next_tick - now)
            if self._relay is None:
                time.sleep(rest_s)
            else:
                self._relay.step(rest_s)

    def _tick(self, now: float) -> None:
        self._reap()
        if self._signal:
            raise _Ended(f"signal {signal.Signals(self._signal).name}")
        if os.getppid() != self._guard:
            raise _Ended("its guard was killed")
        for reason, name in (("preempted", NOTICE), ("told to", END)):
            with contextlib.suppress(StateError):  # a damaged file: not written by us
                at = self._folder.due(name)
                if at is not None and time.time() >= at:
                    raise _Ended(reason)
        if self._folder.exists:
            self._seen_at = now
        elif now > self._seen_at + FOLDER_PATIENCE_S:
            raise _Ended("its folder is gone")
        self._look_at_link()
        if now >= self._log_checked + 5:
            self._log_checked = now
            logfile.bound(self._folder.log)

    def _reap(self) -> None:
        """Reap every child that has exited, including inherited orphans."""
        while True:
            try:
                pid, status = os.waitpid(-1, os.WNOHANG)
            except ChildProcessError:
                return
            if not pid:
                return
            self._statuses[pid] = os.waitstatus_to_exitcode(status)

    def _look_at_link(self) -> None:
        if self._relay is None:
            return
        if self._link.changed():
            try:
                self._faults = faults.read_link(self._link.path)
                log.info("link_changed faults=%s", self._faults)
            except StateError as error:
                log.warning("link_file_ignored reason=%r", error.message)
        self._relay.set_faults(self._faults.at(time.time()))

    def _say(self, state: State) -> None:
        try:
            disk.write_json(self._folder.path / STATE, to_plain(state), durable=False)
        except StateError as error:
            if not self._folder.exists:
                raise _Ended("its folder is gone") from error
            log.error("state_not_written reason=%r", error.message)
            raise

    def _on_signal(self, number: int, _: object) -> None:
        self._signal = number


def _setup_environment(task: Mapping[str, Any]) -> dict[str, str]:
    """Return the environment of `setup`: the user's own plus the task's variables."""
    environ = child_environment(os.environ)
    if sys.prefix != sys.base_prefix:
        environ["PATH"] = f"{sys.prefix}/bin:{environ.get('PATH', os.defpath)}"
    return environ | _variables(task)


def _server_environment(task: Mapping[str, Any], domain: int) -> dict[str, str]:
    """Return the server proxy's environment, including the service's `RMW_IMPLEMENTATION`."""
    given = _variables(task)
    if "PYTHONPATH" in given and "PYTHONPATH" in os.environ:  # fogft may be installed there
        given["PYTHONPATH"] += os.pathsep + os.environ["PYTHONPATH"]
    return {**os.environ, **given, "ROS_DOMAIN_ID": str(domain)}


def _variables(task: Mapping[str, Any]) -> dict[str, str]:
    """Return the variables in a task's `envs` and `secrets`."""
    found = {**(task.get("envs") or {}), **(task.get("secrets") or {})}
    return {str(k): "" if v is None else str(v) for k, v in found.items()}


def _sourced(command: list[str], workdir: Path) -> list[str]:
    """Return a command that runs with the folder's colcon workspace sourced, if it has one."""
    setup = workdir / "install" / "setup.bash"
    if not setup.is_file():
        return command
    return ["bash", "-c", '. "$0"; exec "$@"', str(setup), *command]


if __name__ == "__main__":
    try:
        sys.exit(main(sys.argv[1:]))
    except FogftError as error:
        print(f"error: {error.message}", file=sys.stderr)
        sys.exit(1)
