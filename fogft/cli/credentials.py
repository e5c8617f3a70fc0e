"""``fogft credentials | join | export | import``: a pool's certificates, and moving a pool."""

import contextlib
import logging
import os
import sys
import time
from pathlib import Path
from typing import Annotated

import typer

from fogft import disk
from fogft.cli import output
from fogft.cli.commands import Command, group
from fogft.cli.options import AsJson, PoolName, PoolOption
from fogft.cli.status_text import show_table
from fogft.errors import CredentialError, FogftError
from fogft.model.credentials import Holder, Role
from fogft.model.plain import to_plain, utc
from fogft.pool.commands import composition
from fogft.pool.folder.paths import home

Hours = Annotated[
    float, typer.Option(min=0.1, max=720, metavar="H", help="Hours until it expires.")
]
RoleName = Annotated[
    str, typer.Argument(metavar="ROLE", help="`robot`, `replica`, `gateway` or `rendezvous`.")
]
PassphraseFile = Annotated[
    Path | None,
    typer.Option(
        "--passphrase-file",
        metavar="FILE",
        help="Read the passphrase from a file's first line; `-` for standard input.",
    ),
]


credentials = group("Issue, list, revoke and rotate certificates.")


@credentials.command(cls=Command, epilog="fogft credentials issue robot ada")
def issue(
    role: RoleName,
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name; for a replica, its slot.")],
    *,
    out: Annotated[
        Path | None, typer.Option("--out", "-o", metavar="FILE", help="The file to write.")
    ] = None,
    hours: Hours = 24.0,
    passphrase_file: PassphraseFile = None,
    pool: PoolOption = None,
) -> None:
    """Write a join bundle: a file that lets another machine into the pool, once.

    Without a passphrase of your own, one is generated and shown. Send it separately from the
    file.
    """
    from fogft.pool.commands import joining

    store = composition.store_of(pool)
    file = out or Path(f"{name}.join")
    if file.exists():
        raise FogftError(f"`{file}` exists", "choose another name with `--out`")
    passphrase = _chosen_passphrase(passphrase_file)
    holder, data = joining.issue(
        store, _role(role), name, passphrase, time.time(), open_for_s=hours * 3600
    )
    _show(passphrase, passphrase_file)
    disk.write_whole(file, data)
    output.data(str(file))
    output.done(f"{holder.role.value} `{holder.short}` may join for {hours:g} hours")
    if not store.spec().rendezvous and holder.role is not Role.RENDEZVOUS:
        output.warn(_alone(holder))
    output.hint(f"copy `{file}` to the other machine, and run `fogft join {file.name}` there")


@credentials.command("list", cls=Command, epilog="fogft credentials list")
def list_(as_json: AsJson = False, pool: PoolOption = None) -> None:
    """List the certificates that the pool's CA has issued, without their keys."""
    from fogft.pool.credentials.ledger import Ledger

    now = time.time()
    entries = Ledger(composition.paths_of(pool).credentials).entries()
    if as_json:
        output.json_data(
            [{**to_plain(e.holder), **to_plain(e), "state": e.state(now)} for e in entries]
        )
        return
    rows = [
        (e.holder.role.value, e.holder.short, e.state(now), utc(e.not_after), e.serial[:16])
        for e in entries
    ]
    show_table(("ROLE", "NAME", "STATE", "VALID UNTIL", "SERIAL"), rows)


@credentials.command(cls=Command, epilog="fogft credentials revoke robot ada")
def revoke(
    role: RoleName,
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="`ada` for all of its generations, or `ada.2`.")
    ],
    pool: PoolOption = None,
) -> None:
    """Revoke certificates: every link to their holder is closed permanently.

    A replica whose certificate is revoked is replaced.
    """
    from fogft.pool.commands.change import revoke_credentials

    holders, told = revoke_credentials(composition.store_of(pool), _role(role), name)
    listed = ", ".join(f"`{holder.short}`" for holder in holders)
    are = "is" if len(holders) == 1 else "are"
    if told:
        output.done(f"{role} {listed} {are} revoked")
    else:
        output.warn(f"{role} {listed} {are} revoked, but no manager has told the other members yet")
        output.hint("see `fogft status`: whether one runs, and how to start one")


@credentials.command(cls=Command, epilog="fogft credentials rotate robot")
def rotate(
    role: RoleName,
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="Slot of a replica; by default, all replicas.")
    ] = "",
    pool: PoolOption = None,
) -> None:
    """Renew keys and certificates of the robot or the replicas, without losing a request.

    The robot's links switch to the new ones while requests flow; then the old ones are
    revoked. Replicas are replaced, the new one first. For a robot or gateway on another
    machine, issue a new bundle, join there, and revoke the old generation.
    """
    from fogft.pool.commands.change import rotate_replicas, rotate_robot

    store, which = composition.store_of(pool), _role(role)
    if which is Role.REPLICA:
        if name and not name.isdecimal():
            raise FogftError(f"`{name}` is not a slot", "see `fogft status`")
        replaced = rotate_replicas(store, int(name) if name else None)
        if not replaced:
            raise FogftError(f"`{store.name}` has no replica to replace", "see `fogft status`")
        listed = ", ".join(f"`{one}`" for one in replaced)
        output.done(f"{listed} will be replaced, each with a new key; see `fogft status`")
        return
    if which is not Role.ROBOT or name:
        raise FogftError(
            f"the keys of {f'{role} `{name}`' if name else f'a {role}'} are on another machine",
            f"`fogft credentials issue {role} {name or 'NAME'}`, `fogft join` there, then "
            f"`fogft credentials revoke {role} {name or 'NAME'}.1`",
        )
    holder, old, in_use = rotate_robot(store)
    if not in_use:
        new = f"robot `{holder.short}` has a new certificate"
        output.warn(f"{new}, but its client proxy does not use it yet")
        listed = f"` and `fogft credentials revoke {role} ".join(h.short for h in old)
        output.hint(
            "the old one stays valid; once the new one is in use, run `fogft "
            f"credentials revoke robot {listed}`"
        )
        return
    taken = f"; `{'`, `'.join(h.short for h in old)}` is revoked" if old else ""
    output.done(f"all links use the new keys of robot `{holder.short}`{taken}")


def join(
    bundle: Annotated[
        Path, typer.Argument(metavar="BUNDLE", help="File from `fogft credentials issue`.")
    ],
    passphrase_file: PassphraseFile = None,
) -> None:
    """Join a pool as a robot, gateway or replica, with a join bundle.

    A bundle can be used once, on one machine; the file is then deleted. If the pool has a
    rendezvous, one must be running. To give a robot new keys, join again with a new bundle: a
    running proxy picks them up without losing a request.
    """
    from fogft.pool.commands import joining
    from fogft.pool.credentials.bundle import read_label

    label = read_label(joining.read(bundle))
    whom = f"{label.holder.role.value} `{label.holder.short}` of pool `{label.pool}`"
    output.say(f"this bundle is for {whom}")
    logging.getLogger("fogft.link").addHandler(logging.NullHandler())  # the error has the details
    joined = joining.join(bundle, _read_passphrase(passphrase_file), home(), time.time())
    output.data(str(joined.config))
    output.done(f"this machine has joined as {whom}")
    if joined.alone:
        output.warn(_alone(joined.holder))
    output.hint(f"start it with `fogft {joined.command} --config {joined.config}`")


def export(
    pool: PoolName,
    file: Annotated[Path, typer.Argument(metavar="FILE", help="The file to write.")],
    *,
    hours: Hours = 24.0,
    passphrase_file: PassphraseFile = None,
) -> None:
    """Write a sealed file that moves a pool to another machine.

    This machine stops managing it; `fogft import` takes it over, here or elsewhere. Replicas and
    this machine's client proxy keep answering.
    """
    from fogft.pool.commands import moving

    store = composition.store_of(pool)
    passphrase = _chosen_passphrase(passphrase_file)
    _show(passphrase, passphrase_file)
    identity = moving.export(
        *(store, home(), file, passphrase, time.time()),
        open_for_s=hours * 3600,
        told=lambda what: output.say(f"ended {what}"),
    )
    output.data(str(file))
    output.done(f"`{pool}` is exported; this machine no longer manages it")
    if identity.cloud != composition.LOCAL:
        output.warn(
            "the file does not include SkyPilot's own state: use the same API server there, or "
            "copy `~/.sky` and `~/.ssh/sky-key*` before the import"
        )
    output.hint(f"run `fogft import {file.name}` on the other machine within {hours:g} hours, then "
                f"`fogft down {pool}` here")  # fmt: skip


def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="File from `fogft export`.")],
    *,
    pool_file: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The pool file on this machine, if it has moved."),
    ] = None,
    passphrase_file: PassphraseFile = None,
) -> None:
    """Take over a pool that another machine exported.

    Starts its manager here, and deletes the file. If copies are imported on several machines, all
    but one stop once a replica tells them, within a minute.
    """
    from fogft.pool.commands import joining, moving, startup
    from fogft.pool.credentials.bundle import read_label

    if read_label(joining.read(file)).holder.role is not Role.MANAGER:
        raise FogftError(f"`{file}` lets a machine join a pool", "use it with `fogft join`")
    passphrase = _read_passphrase(passphrase_file)
    store = moving.import_(file, passphrase, home(), time.time(), pool_file=pool_file)
    startup.start_manager(store)
    joining.destroy(file)
    output.done(f"this machine manages `{store.name}`")
    output.hint(f"`fogft credentials rotate robot --pool {store.name}` locks the old machine out")


def _alone(holder: Holder) -> str:
    return (
        f"the pool has no rendezvous: {holder.role.value} `{holder.short}` knows only the replicas "
        "that existed when its bundle was made, and nobody can tell whether a copy of the bundle "
        "is used on another machine"
    )


def _role(text: str) -> Role:
    allowed = {one.value: one for one in (Role.ROBOT, Role.REPLICA, Role.GATEWAY, Role.RENDEZVOUS)}
    if text not in allowed:
        hint = "roles: " + ", ".join(f"`{name}`" for name in allowed)
        raise CredentialError(f"there is no role `{text}`", hint)
    return allowed[text]


def _chosen_passphrase(file: Path | None) -> str:
    from fogft.pool.credentials.bundle import new_passphrase

    return new_passphrase() if file is None else _read_passphrase(file)


def _show(passphrase: str, file: Path | None) -> None:
    """Show a passphrase that is in no file, before there is something that only it opens."""
    if file is not None:
        return
    with contextlib.suppress(OSError):
        print(f"passphrase: {passphrase}", file=sys.stderr, flush=True)
        if not os.path.samestat(os.fstat(2), os.stat(os.devnull)):
            return
    what = "the passphrase cannot be shown: nobody reads standard error"
    raise FogftError(what, "use `--passphrase-file FILE`")


def _read_passphrase(file: Path | None) -> str:
    if file is not None:
        try:
            text = sys.stdin.readline() if str(file) == "-" else file.read_text()
            text.encode()  # stdin accepts bytes that are not text in this locale
        except (OSError, UnicodeError):
            raise FogftError(f"the passphrase file `{file}` cannot be read") from None
        found = text.splitlines()[0].strip() if text.strip() else ""
        if not found:
            raise FogftError(f"the passphrase file `{file}` is empty")
        return found
    if not output.is_terminal(sys.stdin):
        raise FogftError(
            "there is no terminal to ask for the passphrase", "use `--passphrase-file FILE`"
        )
    import getpass

    try:
        return getpass.getpass("passphrase: ").strip()
    except EOFError:
        raise FogftError("no passphrase was given") from None
