"""``scripts/release``: a Debian package of a wheel, with its own environment in /opt/fogft.

    /usr/bin/python3 scripts/debian_package.py WHEEL FOLDER

It is built with Debian's tools (dpkg-deb, help2man, gzip) by the system's Python, which it then
needs: an environment is of one version. Man pages and completion come from the command line
itself; the copyright file has the licence of everything that is bundled.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from email.parser import Parser
from pathlib import Path

HOME = "opt/fogft"
PYTHON = f"{sys.version_info.major}.{sys.version_info.minor}"
CONTROL = """\
Package: fogft
Version: {version}
Architecture: {architecture}
Maintainer: fogft maintainers <noreply@users.noreply.github.com>
Installed-Size: {kilobytes}
Depends: python3 (>= {python}), python3 (<< {python_after}), libc6 (>= 2.28)
Recommends: openssh-client, rsync
Section: net
Priority: optional
Homepage: https://github.com/fogft/fogft
Description: replicated ROS 2 services on cheap, unreliable machines
 A ROS 2 service runs on several machines that may vanish at any moment, such as
 spot VMs. As long as one of them answers, the robot gets its answer.
"""
# Python writes these when it runs; the package's own files are dpkg's to remove.
PRERM = f"""\
#!/bin/sh
set -e
find /{HOME} -name __pycache__ -type d -prune -exec rm -rf {{}} +
"""


def run(*words: str | Path, **options: object) -> str:
    """Run a program and return what it said."""
    done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, **options)
    return done.stdout


def environment(root: Path, wheel: Path) -> None:
    """Install the wheel and all that it depends on below `root`, as if that were /."""
    venv = root / HOME
    run(sys.executable, "-m", "venv", "--without-pip", "--copies", venv)
    for link in ("python", "python3", f"python{PYTHON}"):
        (venv / "bin" / link).unlink(missing_ok=True)
        (venv / "bin" / link).symlink_to(f"/usr/bin/python{PYTHON}")
    run("pip", "--python", venv / "bin" / "python", "install", "-q", "--no-compile", wheel)
    for script in (venv / "bin").iterdir():
        if script.is_symlink() or not script.is_file():
            continue
        script.write_text(script.read_text().replace(str(venv), f"/{HOME}"))
    for name in ("activate.csh", "activate.fish", "Activate.ps1"):
        (venv / "bin" / name).unlink(missing_ok=True)
    for cache in venv.rglob("__pycache__"):
        shutil.rmtree(cache)
    program = root / "usr/bin/fogft"
    program.parent.mkdir(parents=True)
    program.symlink_to(f"/{HOME}/bin/fogft")


def copyright_of(venv: Path) -> str:
    """Return the licence of fogft and of each package that is bundled, with its text."""
    parts = ["Upstream-Name: fogft\nLicense: Apache-2.0\n"]
    for metadata in sorted(venv.rglob("*.dist-info/METADATA")):
        said = Parser().parsestr(metadata.read_text(errors="replace"))
        classifiers = [c for c in said.get_all("Classifier", []) if c.startswith("License")]
        named = said["License-Expression"] or ", ".join(c.split(" :: ")[-1] for c in classifiers)
        named = named or str(said["License"] or "").split("\n")[0]
        if not named:
            raise SystemExit(f"error: the licence of {said['Name']} is not known")
        parts.append(f"\n{'=' * 72}\n{said['Name']} {said['Version']}: {named}\n")
        for text in sorted(metadata.parent.rglob("*")):
            if re.match(r"(LICEN[CS]E|COPYING|NOTICE|AUTHORS)", text.name) and text.is_file():
                parts.append(f"\n--- {text.name}\n{text.read_text(errors='replace')}")
    return "".join(parts)


def manual(root: Path, version: str) -> None:
    """Write a man page for the program and for each of its commands."""
    folder = root / "usr/share/man/man1"
    folder.mkdir(parents=True)
    listed = """
import typer
from fogft.cli.main import app
for name, command in typer.main.get_command(app).commands.items():
    for child in getattr(command, "commands", [""]):
        print(name, child)
"""
    program = root / HOME / "bin" / "python"
    words = ["", *run(program, "-c", listed, env=at(root)).splitlines()]
    for command in words:
        page = folder / f"{'-'.join(['fogft', *command.split()])}.1"
        wrapper = root / "wrapper"
        wrapper.write_text(f'#!/bin/sh\nexec {program} -m fogft {command} "$@"\n')
        wrapper.chmod(0o755)
        said = run(
            *("help2man", "--no-info", "--section=1", f"--version-string={version}"),
            *("--name", f"fogft {command}".strip(), wrapper),
            env=at(root),
        )
        page.write_text(
            said.replace("wrapper", f"fogft {command}".strip()).replace(
                "WRAPPER", page.stem.upper()
            )
        )
        run("gzip", "-9n", page)
        wrapper.unlink()


def completion(root: Path) -> None:
    """Write what bash, zsh and fish complete by."""
    for shell, name in {
        "bash": "usr/share/bash-completion/completions/fogft",
        "zsh": "usr/share/zsh/vendor-completions/_fogft",
        "fish": "usr/share/fish/vendor_completions.d/fogft.fish",
    }.items():
        said = run(
            root / HOME / "bin" / "python", "-m", "fogft", "--show-completion", shell,
            env={**at(root), "_TYPER_COMPLETE_TEST_DISABLE_SHELL_DETECTION": "1"},
        )  # fmt: skip
        (root / name).parent.mkdir(parents=True)
        (root / name).write_text(said)


def at(root: Path) -> dict[str, str]:
    """Return an environment in which the packed fogft runs from where it is built."""
    packages = root / HOME / "lib" / f"python{PYTHON}" / "site-packages"
    return {
        **os.environ,
        "PYTHONPATH": str(packages),
        "PYTHONDONTWRITEBYTECODE": "1",
        "COLUMNS": "80",
    }


def main(wheel: Path, into: Path) -> None:
    """Build the package."""
    version = wheel.name.split("-")[1]
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        root.chmod(0o755)
        environment(root, wheel)
        manual(root, version)
        completion(root)
        documents = root / "usr/share/doc/fogft"
        documents.mkdir(parents=True)
        (documents / "copyright").write_text(copyright_of(root / HOME))
        if (into / "sbom.cdx.json").exists():
            shutil.copy(into / "sbom.cdx.json", documents)
        size = sum(f.lstat().st_size for f in root.rglob("*") if not f.is_dir())
        architecture = run("dpkg", "--print-architecture").strip()
        (root / "DEBIAN").mkdir()
        major, minor = PYTHON.split(".")
        control = CONTROL.format(
            version=version,
            architecture=architecture,
            kilobytes=size // 1024,
            python=PYTHON,
            python_after=f"{major}.{int(minor) + 1}",
        )
        (root / "DEBIAN/control").write_text(control)
        (root / "DEBIAN/prerm").write_text(PRERM)
        (root / "DEBIAN/prerm").chmod(0o755)
        package = into / f"fogft_{version}_{architecture}.deb"
        run("dpkg-deb", "--root-owner-group", "--build", root, package)
        print(package)


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]).resolve())
