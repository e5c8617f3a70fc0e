"""Make the home of whoever launches: credentials, SkyPilot's configuration and its catalogue.

The catalogue is a small one of the emulation's own: three regions with two zones each. SkyPilot
maps zone ids (`use1-az1`) to names by asking AWS, as it does with the real catalogue.
"""

from __future__ import annotations

import csv
import re
import sys
from importlib.util import find_spec
from pathlib import Path

REGIONS = {"us-east-1": ("use1", 0.020), "us-west-2": ("usw2", 0.025), "eu-west-1": ("euw1", 0.040)}
OTHERS = (
    ("m5.large", 8, "x86_64", 0.002),
    ("r5.large", 16, "x86_64", 0.004),
    ("c5.large", 4, "x86_64", 0.001),
    ("m6g.large", 8, "arm64", 0.001),
    ("t3.large", 8, "x86_64", 0.001),
)
IMAGE = "ami-1e749f67"  # one that moto has in every region
MARK = "a credential of the lab's"
OF_OTHER_CLOUDS = (
    ".config/gcloud/application_default_credentials.json",
    ".config/vastai/vast_api_key",
)
VMS = (
    "InstanceType,AcceleratorName,AcceleratorCount,vCPUs,MemoryGiB,GpuInfo,Price,SpotPrice,"
    "Region,AvailabilityZone,Arch"
)


def main(home: Path) -> None:
    spec = find_spec("sky")
    assert spec is not None
    assert spec.origin is not None
    constants = (Path(spec.origin).parent / "skylet" / "constants.py").read_text()
    version = re.search(r"CATALOG_SCHEMA_VERSION\s*=\s*'([^']+)'", constants)
    assert version is not None
    catalogue = home / ".sky" / "catalogs" / version[1]
    rows = [
        [kind, "", "", cpus, 4 * cpus, "", 0.05 * cpus, spot * cpus / 2 + n / 1000, region,
         f"{zone}-az{n}", "x86_64"]
        for region, (zone, spot) in REGIONS.items()
        for n in (1, 2)
        for kind, cpus in (("m6i.large", 2), ("m6i.xlarge", 4))
    ]  # fmt: skip
    for region, (zone, spot) in REGIONS.items():  # what may come in place of an `m6i.large`
        for kind, memory, arch, more in OTHERS:
            price = 0.1 + more, spot + more
            row = [kind, "", "", 2, memory, "", *price, region, f"{zone}-az1", arch]
            rows.append(row)
    write(catalogue / "aws/vms.csv", VMS.split(","), rows)
    tags = ("cpu-ubuntu", "gpu-ubuntu", "gpu-ubuntu-cuda13")
    images = [
        [f"skypilot:custom-{tag}", region, "ubuntu", "22.04", IMAGE, "20240101"]
        for region in REGIONS
        for tag in tags
    ]
    header = ["Tag", "Region", "OS", "OSVersion", "ImageId", "CreationDate"]
    write(catalogue / "aws/images.csv", header, images)
    quotas = ["InstanceType", "OnDemandInstanceCode", "SpotInstanceCode"]
    kinds = ("m6i.large", "m6i.xlarge", *(kind for kind, *_ in OTHERS))
    codes = [[kind, "L-1216C47A", "L-34B43A08"] for kind in kinds]
    write(catalogue / "aws/instance_quota_mapping.csv", quotas, codes)
    write(catalogue / "common/metadata.csv", ["GPU", "MemoryGB"], [])
    text(
        home / ".aws/credentials", "[default]\naws_access_key_id=test\naws_secret_access_key=test\n"
    )
    for name in OF_OTHER_CLOUDS:
        text(home / name, MARK)


def write(path: Path, header: list[str], rows: list[list[object]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([header, *rows])


def text(path: Path, content: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
