"""What fogft thinks of SkyPilot against the SkyPilot that is installed.

The scripted SkyPilot of the other tests is only as good as its likeness: here the surface,
the calls behind it and every name that is matched by text are held to the real thing.
"""

from __future__ import annotations

import inspect
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from fnmatch import fnmatchcase
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import pytest

from fogft.cloud.sky import sdk, settings, task
from fogft.cloud.sky.adapter import SkyCloud
from fogft.cloud.sky.installed import InstalledSky
from fogft.cloud.sky.naming import cluster_name
from fogft.cloud.sky.sdk import ClusterState, JobState, RefusedError, Sale
from fogft.errors import CloudError, CloudUnreachable
from fogft.model.names import VM_CLOUDS
from fogft.model.replica import Placement
from tests.fakes.sky import EAST, ScriptedSky, replica
from tests.needs import needs
from tests.sky.scene import Scene

SURFACE = [name for name, member in vars(InstalledSky).items() if inspect.isfunction(member)]


@pytest.mark.parametrize("name", [n for n in SURFACE if not n.startswith("_") and n != "within"])
def test_the_scripted_sky_has_the_surface_of_the_installed_one(name: str):
    """Same names, same parameters, in the same order."""
    expected = inspect.signature(getattr(InstalledSky, name)).parameters.values()
    found = inspect.signature(getattr(ScriptedSky, name)).parameters.values()
    assert [(p.name, p.kind, p.default) for p in found] == [
        (p.name, p.kind, p.default) for p in expected
    ]


def test_the_reasons_of_sky_check_are_found_in_its_text():
    told = (
        "Checking credentials to enable clouds for SkyPilot.\n"
        "  \x1b[33mAWS: disabled\x1b[0m\n"
        "    Reason [compute]: AWS credentials are not set. Run the following commands:\n"
        "      $ aws configure\n"
        "    For more info: https://docs.aws.amazon.com/\n"
        "  GCP: enabled [compute, storage]\n"
        "  Azure: disabled\n"
        "    Reason [compute]: Getting user's Azure identity failed.\n"
        "\n"
        "\x1b[32m🎉 Enabled infra 🎉\x1b[0m\n"
        "  GCP [compute, storage]\n"
    )
    reasons = sdk.told_reasons(told)
    assert set(reasons) == {"aws", "azure"}
    assert reasons["aws"].endswith("Run the following commands: $ aws configure")
    assert reasons["azure"] == "Getting user's Azure identity failed."


def test_without_skypilot_the_error_says_what_to_install(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "sky", None)
    with pytest.raises(Exception, match="cannot be used here") as caught:
        InstalledSky().request("r1")
    assert "fogft[cloud]" in caught.value.hint  # type: ignore[attr-defined]


@needs("skypilot")
def test_its_import_makes_no_command_log_to_the_terminal(home: Path):
    """SkyPilot's own modules set up a log on stderr."""
    code = (
        "import logging; from fogft.cloud.sky.installed import InstalledSky; "
        "InstalledSky().load(); logging.getLogger('fogft').warning('told to nobody')"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=100
    )
    assert "told to nobody" not in ended.stderr


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A home with the emulation's catalogue: SkyPilot must not fetch one, nor touch the user's."""
    folder = tmp_path_factory.mktemp("home")
    made = Path(__file__).parent / "emulated_aws" / "home.py"
    subprocess.run([sys.executable, made, str(folder)], check=True, timeout=100)
    isolated = {
        "HOME": str(folder),
        "SKYPILOT_DISABLE_LOCAL_API_SERVER": "1",
        "SKYPILOT_DISABLE_USAGE_COLLECTION": "1",
        "AWS_ENDPOINT_URL": "http://127.0.0.1:1",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_EC2_METADATA_DISABLED": "true",
    }
    with mock.patch.dict(os.environ, isolated):
        yield folder


@pytest.fixture
def real(home: Path) -> Iterator[tuple[InstalledSky, Any, Any]]:
    """The adapter on SkyPilot's own functions, which check their arguments and do nothing."""
    import sky
    from sky import skypilot_config
    from sky.client import sdk

    before = skypilot_config.to_dict()

    silent = mock.create_autospec(sdk)
    installed = InstalledSky()
    installed.sky, installed.sdk = sky, silent
    yield installed, silent, sky
    skypilot_config._set_loaded_config(before)


def status_record(**changes: Any) -> Any:
    from sky.schemas.api.responses import StatusResponse
    from sky.utils.status_lib import ClusterStatus

    chosen = SimpleNamespace(
        cloud="AWS", region="us-east-1", zone="us-east-1a", instance_type="m6i.large",
        use_spot=True, labels={"a": "b"},
    )  # fmt: skip
    fields: dict[str, Any] = {
        "name": "c", "launched_at": 5, "status": ClusterStatus.UP, "autostop": 5,
        "to_down": True, "cluster_hash": "h", "cluster_ever_up": True, "user_hash": "u",
        "user_name": "n", "workspace": "default", "is_managed": False, "nodes": 1,
        "handle": SimpleNamespace(head_ip="10.0.0.1", launched_resources=chosen),
        "labels": {"a": "b"},
    }  # fmt: skip
    return StatusResponse(**{**fields, **changes})


def payload(**changes: Any) -> Any:
    from sky.server.requests.payloads import RequestPayload

    fields: dict[str, Any] = {
        "request_id": "r1", "name": "sky.launch", "entrypoint": "", "request_body": "",
        "status": "RUNNING", "created_at": 1.0, "user_id": "u", "return_value": "", "error": "",
        "pid": None, "schedule_type": "long", "cluster_name": "c", "status_msg": None,
    }  # fmt: skip
    return RequestPayload(**{**fields, **changes})


@needs("skypilot")
def test_every_call_fits_the_installed_signatures(real: tuple[InstalledSky, Any, Any]):
    """`create_autospec` refuses an argument that the real function does not take."""
    installed, sdk, _ = real
    sdk.launch.return_value = "r1"
    assert installed.launch({"run": "true"}, "c") == "r1"
    sdk.api_status.return_value = [payload(), payload(name="sky.status"), payload(cluster_name="d")]
    assert [r.active for r in installed.launches("c")] == [True]
    assert installed.request("r1") is not None
    assert installed.request("r2") is None
    sdk.get.return_value = (3, None)
    assert installed.launched_job("r1") == 3
    installed.cancel("r1")
    sdk.get.return_value = [status_record()]
    assert installed.clusters("c", refresh=True)[0].head_ip == "10.0.0.1"
    assert installed.clusters(None, refresh=False)[0].placement == EAST
    from sky import JobStatus

    sdk.get.return_value = {3: JobStatus.FAILED_SETUP}
    assert installed.job("c", 3) is JobState.SETUP_FAILED
    sdk.get.return_value = {None: None}
    assert installed.job("c", None) is JobState.MISSING
    sdk.get.return_value = {7448: "http://203.0.113.9:31022"}
    assert installed.endpoint("c", 7448) == "203.0.113.9:31022"
    installed.job_log("c", 3, 10)
    installed.provision_log("c", 10)
    installed.down("c")
    sdk.stream_and_get.return_value = {"default": {"AWS": ["compute", "storage"]}}
    assert installed.check(["aws", "gcp"]) == {"aws": "", "gcp": "SkyPilot has no access to it"}
    called = {call[0] for call in sdk.method_calls}
    assert called >= {
        *("endpoints", "launch", "api_status", "api_cancel", "status", "job_status", "tail_logs"),
        *("tail_provision_logs", "down", "check", "stream_and_get", "get"),
    }


@needs("skypilot")
def test_every_launch_asks_for_the_guard_once_after_the_users_own_commands(
    real: tuple[InstalledSky, Any, Any], monkeypatch: pytest.MonkeyPatch
):
    """A request carries it to the API server, which writes it into the order on AWS."""
    from sky import skypilot_config
    from sky.server.requests.payloads import get_override_skypilot_config_from_client as carried

    installed, silent, _ = real
    silent.launch.return_value = "r1"
    # As the functions of the SDK do, whose place is taken here.
    monkeypatch.setattr("sky.utils.annotations.is_on_api_server", False)
    skypilot_config.apply_cli_config(
        ["aws.post_provision_runcmd=[echo mine]", "allowed_clouds=[aws]"]
    )
    for _ in range(2):
        installed.launch({"run": "serve"}, "c")
        asked = carried()["aws"]["post_provision_runcmd"]
        assert asked == ["echo mine", settings.guard()]
        assert carried()["gcp"]["remote_identity"] == "NO_UPLOAD"
    assert carried()["allowed_clouds"] == ["aws"], "all else is as it was"


@needs("skypilot")
@pytest.mark.parametrize(
    ("own", "kept"),
    [([], []), (["aws.security_group_name=theirs"], [{"*": "theirs"}]),
     (["aws.security_group_name=[{other-*: theirs}]"], [{"other-*": "theirs"}])],
)  # fmt: skip
def test_a_pool_that_says_who_may_connect_has_its_group_before_the_users_own(
    real: tuple[InstalledSky, Any, Any],
    monkeypatch: pytest.MonkeyPatch,
    own: list[str],
    kept: list[dict[str, str]],
):
    """SkyPilot takes the first pattern that a cluster's name matches."""
    from sky import skypilot_config
    from sky.server.requests.payloads import get_override_skypilot_config_from_client as carried

    installed, silent, _ = real
    silent.launch.return_value = "r1"
    monkeypatch.setattr("sky.utils.annotations.is_on_api_server", False)
    skypilot_config.apply_cli_config(own)

    def launched(generation: int, group: str) -> Any:
        name = cluster_name(replica(0, generation))
        installed.launch({"run": "serve"}, name, group)
        return carried()["aws"].get("security_group_name", [])

    for generation in (1, 2):
        ours, *others = launched(generation, "fogft-0123")
        (pattern,) = ours
        assert fnmatchcase(cluster_name(replica(0, generation)), pattern)
        assert not fnmatchcase("other-fogft", pattern)
        assert (ours[pattern], others) == ("fogft-0123", kept)
    assert launched(3, "") == kept, "the pool file names nobody any more"


FILES_OF_CLOUDS = (
    *(".aws/credentials", ".config/gcloud/application_default_credentials.json"),
    *(".azure/msal_token_cache.json", ".config/vastai/vast_api_key"),
    *(".lambda_cloud/lambda_keys", ".runpod/config.toml"),
)


@pytest.fixture
def credentials(home: Path) -> Iterator[Any]:
    """A user's home with credentials of many clouds; SkyPilot's settings, as they were after."""
    from sky import skypilot_config

    for name in FILES_OF_CLOUDS:
        (home / name).parent.mkdir(parents=True, exist_ok=True)
        (home / name).write_text("secret")
    before = skypilot_config.to_dict()
    yield skypilot_config
    skypilot_config._set_loaded_config(before)


@needs("skypilot")
def test_a_vm_gets_no_credentials_that_skypilot_can_leave_out(home: Path, credentials: Any):
    """What SkyPilot itself would send is what is told: files of clouds without the setting."""
    from sky import check

    sent = {name for name in check.get_cloud_credential_file_mounts(None) if "~/.aws" not in name}
    assert sent >= {"~/.config/vastai/vast_api_key", "~/.lambda_cloud/lambda_keys"}
    left = InstalledSky().uploaded_credentials(["aws"])
    assert left == ["~/.lambda_cloud/lambda_keys", "~/.runpod/config.toml"]


@needs("skypilot")
def test_what_the_user_chose_stays(home: Path, credentials: Any):
    credentials.apply_cli_config(["gcp.remote_identity=LOCAL_CREDENTIALS"])
    credentials.apply_cli_config(["aws.remote_identity=my-role"])
    for _ in range(2):
        left = InstalledSky().uploaded_credentials(["aws"])
        assert left is not None
        assert "~/.config/gcloud/application_default_credentials.json" in left
        assert credentials.get_nested(("aws", "remote_identity"), None) == "my-role"


@needs("skypilot")
def test_a_vm_that_ends_itself_by_its_clouds_files_gets_these(home: Path, credentials: Any):
    installed = InstalledSky()
    assert "~/.config/vastai/vast_api_key" not in (installed.uploaded_credentials(["aws"]) or ())
    assert "~/.config/vastai/vast_api_key" in (installed.uploaded_credentials(["vast"]) or ())


@pytest.mark.parametrize(("chosen", "then"), [(None, "1"), ("0", "0")])
def test_usage_reports_are_off_unless_the_user_chose(
    chosen: str | None, then: str, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv(settings.NO_REPORTS, "")
    monkeypatch.delenv(settings.NO_REPORTS)
    if chosen is not None:
        monkeypatch.setenv(settings.NO_REPORTS, chosen)
    monkeypatch.setitem(sys.modules, "sky", None)
    with pytest.raises(CloudError):
        InstalledSky().request("r1")
    assert os.environ[settings.NO_REPORTS] == then


@needs("skypilot")
def test_the_guard_is_what_cloud_init_reads(home: Path):
    """SkyPilot writes commands into its text for AWS as they are."""
    import jinja2
    import sky
    import yaml

    text = (Path(sky.__file__).parent / "templates" / "aws-ray.yml.j2").read_text()
    start = text.index("{%- if runcmd %}")
    part = text[start : text.index("TagSpecifications", start)]
    written = jinja2.Template(part).render(runcmd=["echo mine", settings.guard()])
    assert yaml.safe_load(written) == {"runcmd": ["echo mine", settings.guard()]}


@needs("skypilot")
def test_records_read_what_skypilot_says(home: Path):
    record = sdk.cluster_of(status_record())
    assert (record.state, record.labels, record.launched_at) == (ClusterState.UP, {"a": "b"}, 5.0)
    early = sdk.cluster_of(status_record(handle=None, labels=None, init_status_reason="boots"))
    assert (early.placement, early.head_ip, early.progress) == (None, "", "boots")


@needs("skypilot")
def test_the_names_that_are_matched_by_text_exist(home: Path):
    """A SkyPilot that renames one of them must not turn "nobody knows" into "no"."""
    import requests
    from sky import ClusterStatus, JobStatus, exceptions
    from sky.server.requests.requests import RequestStatus

    builtin = dir(__import__("builtins")) + dir(requests.exceptions)
    assert [n for n in sdk.UNKNOWN if not hasattr(exceptions, n) and n not in builtin] == []
    assert {s.value for s in RequestStatus} >= sdk.ENDED
    assert {s.value for s in JobStatus} >= set(sdk.JOBS)
    assert {s.value for s in ClusterStatus} >= {"INIT", "UP", "STOPPED"}
    for name in ("ClusterDoesNotExist", "ResourcesUnavailableError", "CommandError",
                 "ClusterSetUpError", "RequestCancelled", "PermissionDeniedError"):  # fmt: skip
        assert hasattr(exceptions, name)


@needs("skypilot")
def test_what_skypilot_raises_becomes_ours(real: tuple[InstalledSky, Any, Any]):
    from sky import exceptions

    installed, sdk, _ = real
    full = exceptions.ResourcesUnavailableError(
        "Failed to acquire resources",
        failover_history=[Exception("InsufficientInstanceCapacity"), Exception("and again")],
    )
    sdk.get.side_effect = full
    with pytest.raises(RefusedError) as refused:
        installed.launched_job("r1")
    assert refused.value.kind == "ResourcesUnavailableError"
    assert "InsufficientInstanceCapacity" in refused.value.texts[1]
    sdk.get.side_effect = exceptions.CloudError("expired", "botocore", "ExpiredToken")
    with pytest.raises(RefusedError):
        installed.launched_job("r1")
    with pytest.raises(CloudUnreachable):
        installed.clusters("c", refresh=True)
    for error in (
        exceptions.ClusterStatusFetchingError("?"),
        exceptions.ApiServerConnectionError("http://x"),
        exceptions.ServerTemporarilyUnavailableError("?"),
    ):
        sdk.get.side_effect = error
        with pytest.raises(CloudUnreachable):
            installed.clusters("c", refresh=True)
    sdk.get.side_effect = exceptions.ClusterDoesNotExist("c")
    installed.down("c")
    sdk.get.side_effect = RuntimeError("Failed to terminate")
    with pytest.raises(RefusedError):
        installed.down("c")


@needs("skypilot")
def test_a_task_that_we_build_is_one_that_skypilot_takes(home: Path, tmp_path: Path):
    """The template and the merge, judged by SkyPilot's own schema and its catalogue."""
    import sky

    (tmp_path / "models").mkdir()
    order = Scene(tmp_path).order(
        task={
            "workdir": ".",
            "file_mounts": {"/models": "models"},
            "envs": {"A": "b"},
            "secrets": {"TOKEN": "t"},
            "setup": "colcon build",
            "resources": {
                "cpus": "2+",
                "disk_size": 100,
                "any_of": [{"infra": "aws/us-west-2"}, {"infra": "aws/us-east-1"}],
            },
        }
    )
    built = task.build(order, files=tmp_path, wheel=tmp_path, owner="ann")
    made = sky.Task.from_yaml_config(built)
    (resources,) = made.resources
    assert (resources.region, resources.zone) == ("us-east-1", "us-east-1a")
    assert (resources.instance_type, resources.use_spot) == ("m6i.large", True)
    assert resources.ports == ["7448"]
    assert resources.autostop_config.down
    assert resources.disk_size == 100
    assert made.envs["A"] == "b"


@needs("skypilot")
def test_an_image_of_the_users_own_is_one_that_skypilot_takes(home: Path, tmp_path: Path):
    """A container's image, and an image of the cloud."""
    import sky

    for image in ("docker:ros:jazzy", "docker:registry.example.org/team/robot:1", "ami-1e749f67"):
        asked = {"resources": {"infra": "aws/us-east-1", "image_id": image}}
        built = task.build(
            Scene(tmp_path).order(task=asked), files=tmp_path, wheel=tmp_path,
            owner="ann",
        )  # fmt: skip
        (resources,) = sky.Task.from_yaml_config(built).resources
        container = image.removeprefix("docker:") if image.startswith("docker:") else None
        assert resources.extract_docker_image() == container
        assert container or resources.image_id == {"us-east-1": image}
        assert resources.ports == ["7448"], "SkyPilot's containers share the machine's network"


@needs("skypilot")
def test_a_task_without_ports_is_one_that_skypilot_takes(home: Path, tmp_path: Path):
    """That of a replica that dials out."""
    import sky

    built = task.build(
        Scene(tmp_path).order(dials_out=True), files=tmp_path, wheel=tmp_path,
        owner="ann",
    )  # fmt: skip
    (resources,) = sky.Task.from_yaml_config(built).resources
    assert resources.ports is None


@needs("skypilot")
def test_offers_come_from_the_catalogue(home: Path, real: tuple[InstalledSky, Any, Any]):
    """With no network the catalogue's zones have ids, not names: then the region is the offer."""
    installed, _, sky = real

    def sold(**resources: Any) -> Sale:
        return installed.offers(task.as_launched(resources))

    found = sold(infra="aws/us-west-2", cpus="2", use_spot=True)
    kinds = ["m6i.large", "m5.large", "r5.large", "c5.large"]
    assert [o.placement for o in found.offers] == [
        Placement("aws", "us-west-2", "", kind) for kind in kinds[:3]
    ], "no less memory than the one that SkyPilot chooses, none on Arm, none that is burstable"
    assert found.offers[0].usd_per_hour == pytest.approx(0.026)
    assert {offer.source for offer in found.offers} == {"catalogue"}
    assert found.quotas["m6i.large", True] == ("L-34B43A08", 2)
    catalogue = home / ".sky/catalogs/v8/aws/vms.csv"
    assert {offer.as_of for offer in found.offers} == {catalogue.stat().st_mtime}
    steady = sold(infra="aws/us-west-2", cpus="4", use_spot=False).offers
    assert {(o.placement.instance, o.placement.spot) for o in steady} == {("m6i.xlarge", False)}
    for spot in (True, False):
        everywhere = sold(infra="aws", cpus="2", use_spot=spot).offers
        assert {o.placement.region for o in everywhere} == {"us-east-1", "us-west-2", "eu-west-1"}
        for offer in everywhere:
            place = offer.placement
            asked = sky.Resources(
                cloud=sky.AWS(), instance_type=place.instance, region=place.region, use_spot=spot
            )
            assert offer.usd_per_hour == asked.get_cost(3600), "SkyPilot's own price"
    nothing = sold(infra="aws", cpus="1000+")
    assert (nothing.offers, nothing.left_out) == ([], {"aws": "nothing there matches"})
    with pytest.raises(RefusedError, match="cpus"):
        sold(infra="aws", cpus="two")


@needs("skypilot")
def test_a_cloud_that_refuses_the_launch_is_left_out_with_the_reason(
    home: Path, real: tuple[InstalledSky, Any, Any]
):
    """Asked with ports, spot and autodown, as it will be launched; nobody's prices are needed."""
    installed, _, _ = real
    asked = task.as_launched({"infra": "hyperbolic", "use_spot": True})
    assert installed.offers(asked).left_out == {
        "hyperbolic": "machines cannot terminate themselves; cannot open ports (not needed with "
        "`fogft.dial_in`); no spot machines"
    }
    for cloud, labels in {"aws": {"team": "Robots A"}, "gcp": {"Team": "a"}}.items():
        asked = task.as_launched({"infra": cloud, "labels": {"ours": "1", **labels}})
        ((_, why),) = installed.offers(asked).left_out.items()
        ((label, value),) = labels.items()
        assert why.startswith(f"refuses the label `{label}: {value}` (")


@needs("skypilot")
def test_the_pages_table_of_clouds_is_what_skypilot_says(home: Path, tmp_path: Path):
    """Of the pool that is the default: spot machines, one port, and a machine that ends itself."""
    page = (Path(__file__).parents[2] / "docs/how-to/clouds.md").read_text()
    cloud = SkyCloud(tmp_path / "sky", InstalledSky(), owner="ann")
    lacking = cloud.lacking({"use_spot": True, "cpus": "2+"})
    assert tuple(lacking) == VM_CLOUDS
    for name, why in lacking.items():
        steady = cloud.lacking({"use_spot": False})[name]
        default = "no" if steady else "on demand only" if why else "yes"
        assert f"| `{name}` | {default} | {why} |" in page


@needs("skypilot")
def test_a_task_with_several_types_is_one_that_skypilot_takes_in_this_order(
    home: Path, tmp_path: Path
):
    import sky

    others = [replace(EAST, instance=kind) for kind in ("m5.large", "r5.large")]
    built = task.build(
        Scene(tmp_path).order(), files=tmp_path, wheel=tmp_path, owner="ann",
        instead=others,
    )  # fmt: skip
    resources = sky.Task.from_yaml_config(built).resources
    assert isinstance(resources, list), "in order"
    assert [one.instance_type for one in resources] == ["m6i.large", "m5.large", "r5.large"]
    for one in resources:
        assert (one.region, one.zone, one.use_spot) == (EAST.region, EAST.zone, True)
        assert (one.ports, one.disk_size, one.labels["fogft-slot"]) == (["7448"], 64, "0")


@needs("skypilot")
def test_skypilot_tries_the_next_type_where_one_has_no_capacity(
    home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Its own optimizer, told what was refused; also after the way to the API server."""
    import sky
    from sky import optimizer

    monkeypatch.setattr(
        "sky.check.get_cached_enabled_clouds_or_refresh", lambda *_, **__: [sky.AWS()]
    )
    place = replace(EAST, zone="")
    others = [replace(place, instance=kind) for kind in ("m5.large", "r5.large")]
    built = task.build(
        Scene(tmp_path).order(place=place), files=tmp_path, wheel=tmp_path,
        owner="ann", instead=others,
    )  # fmt: skip
    sent = sky.Task.from_yaml_config(sky.Task.from_yaml_config(built).to_yaml_config())
    refused: list[Any] = []
    came = []
    for _ in range(3):
        with sky.Dag() as dag:
            dag.add(sent)
        optimizer.Optimizer.optimize(dag, blocked_resources=refused, quiet=True)
        best = sent.best_resources
        came.append(best.instance_type)
        assert (best.region, best.use_spot, best.autostop_config.down) == ("us-east-1", True, True)
        refused.append(
            sky.Resources(
                cloud=sky.AWS(), instance_type=came[-1], region=best.region, use_spot=True
            )
        )
        sent.best_resources = None
    assert came == ["m6i.large", "m5.large", "r5.large"]


@needs("skypilot")
def test_an_api_server_of_another_skypilot_is_named_and_ended_only_when_idle(
    monkeypatch: pytest.MonkeyPatch,
):
    """One elsewhere is left to its administrator."""
    import sky
    from sky.schemas.api.responses import APIHealthResponse

    assert {"version"} <= set(APIHealthResponse.model_fields)
    installed, sdk = InstalledSky(), mock.create_autospec(sky.client.sdk)
    installed.sky, installed.sdk = sky, sdk
    local = mock.Mock(return_value=True)
    monkeypatch.setattr("sky.server.common.is_api_server_local", local)
    sdk.api_info.return_value = SimpleNamespace(version=sky.__version__)
    assert installed.renew_server() == ""
    sdk.api_info.return_value = SimpleNamespace(version="0.9.0")

    def request(status: str, user: str = "ann") -> SimpleNamespace:
        return SimpleNamespace(request_id="r1", status=status, user_id=user, user_name=user)

    sdk.api_status.return_value = [request("RUNNING")]
    assert (
        f"is 0.9.0, but {sky.__version__} is installed here: it is busy" in installed.renew_server()
    )
    sdk.api_stop.assert_not_called()
    daemon = request("RUNNING", "skypilot-system")
    sdk.api_status.return_value = [request("SUCCEEDED"), daemon]
    assert installed.renew_server().endswith("it was idle and has been restarted")
    sdk.api_stop.assert_called_once()
    local.return_value = False
    assert installed.renew_server().endswith("is installed here")
    sdk.api_stop.assert_called_once()
    sdk.api_info.side_effect = sky.exceptions.APIVersionMismatchError("too old")
    with pytest.raises(CloudUnreachable, match="too old") as caught:
        installed.renew_server()
    assert "sky api stop" in caught.value.hint


@needs("skypilot")
def test_the_clouds_that_a_pool_file_can_name_are_skypilots():
    import sky

    from fogft.model.names import NO_VM_CLOUDS, VM_CLOUDS

    assert set(sky.CLOUD_REGISTRY) == {*VM_CLOUDS, *NO_VM_CLOUDS} - {"k8s"}
