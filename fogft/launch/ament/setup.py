"""Build the package of the project's own pyproject.toml with colcon.

All values are read from pyproject.toml, so a workspace installs the same package as pip.
"""

import os
from pathlib import Path

from setuptools import find_namespace_packages, setup

try:
    import tomllib
except ModuleNotFoundError:  # Python 3.10
    from setuptools._vendor import tomli as tomllib

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
SOURCE = os.path.relpath(ROOT, HERE)

templates = [
    str(path.relative_to(ROOT / "templates"))
    for path in (ROOT / "templates").rglob("*")
    if path.is_file() and "__pycache__" not in path.parts
]
groups = dict.fromkeys(("console_scripts",), PROJECT["scripts"]) | PROJECT["entry-points"]
setup(
    name=PROJECT["name"],
    version=PROJECT["version"],
    description=PROJECT["description"],
    license=PROJECT["license"],
    python_requires=PROJECT["requires-python"],
    package_dir={"": SOURCE, "fogft.templates": os.path.join(SOURCE, "templates")},
    packages=[*find_namespace_packages(SOURCE, include=["fogft", "fogft.*"]), "fogft.templates"],
    package_data={"fogft.templates": templates},
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/fogft"]),
        ("share/fogft", ["package.xml"]),
    ],
    install_requires=["setuptools"],
    zip_safe=False,
    entry_points={
        group: [f"{name} = {target}" for name, target in entries.items()]
        for group, entries in groups.items()
    },
)
