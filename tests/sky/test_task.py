"""The pool file's task reaches SkyPilot untouched, and what a pool decides is refused."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import pip
import pytest

from fogft import template_files
from fogft.cloud.local import processes
from fogft.cloud.port import Launch
from fogft.cloud.sky import naming, task
from fogft.errors import SpecError
from fogft.model.names import SETUP_LIMIT_S
from fogft.model.replica import Placement
from tests.fakes.sky import EAST, WEST, replica
from tests.fakes.waiting import wait_for
from tests.needs import needs

LIMIT_S = 240.0  # of a script that hangs: a machine that is busy with other tests takes long


def built(
    asked: Mapping[str, Any], place: Placement = EAST, *, dials_out: bool = False
) -> dict[str, Any]:
    order = Launch(replica(3, 7), "perception", place, 0.021, "abcd", asked, dials_out=dials_out)
    return task.build(
        order,
        files=Path("/state/files"),
        wheel=Path("/state/wheel"),
        owner="Ann Lee@robot",
    )


def test_one_location_one_port_our_labels_and_an_end_by_itself():
    asked = {"cpus": "4+", "disk_size": None, "any_of": [{"infra": "aws/us-east-1"}]}
    resources = built({"resources": asked})["resources"]
    assert resources["disk_size"] == 64
    assert resources["infra"] == "aws/us-east-1/us-east-1a"
    assert resources["instance_type"] == "m6i.large"
    assert resources["use_spot"] is True
    assert resources["ports"] == ["7448"]
    assert resources["autostop"]["down"] is True
    assert "cpus" not in resources  # the type says it, and may be of another alternative
    assert "any_of" not in resources
    assert naming.replica_of_labels(resources["labels"]) == replica(3, 7)
    assert resources["labels"][naming.OWNER] == "ann_lee_robot"


PASSED_THROUGH: Mapping[str, Any] = {
    "envs": {"MODEL": "yolo"},
    "secrets": {"TOKEN": "t"},
    "config": {"docker": {"run_options": ["--ipc=host"]}},
    "volumes": {"/data": "my-volume"},
    "event_callback": "echo",
    "some_future_field": {"x": [1]},
}


@pytest.mark.parametrize("key", PASSED_THROUGH)
def test_other_fields_pass_through_untouched(key: str):
    assert built(PASSED_THROUGH)[key] == PASSED_THROUGH[key]


@pytest.mark.parametrize(
    "extra",
    [
        {"image_id": "docker:ros:jazzy"},
        {"image_id": {"us-east-1": "ami-1"}},
        {"disk_size": 100, "disk_tier": "best"},
        {"network_tier": "best"},
        {"max_hourly_cost": 1.5},
        {"some_future_field": 1},
    ],
)
def test_other_resources_pass_through_untouched(extra: dict[str, Any]):
    resources = built({"resources": {"infra": "aws", **extra}})["resources"]
    assert {k: resources[k] for k in extra} == extra


def test_the_alternative_that_sells_the_placement_gives_its_own_fields():
    asked = {
        "resources": {
            "disk_size": 50,
            "labels": {"team": "a"},
            "any_of": [
                {"infra": "aws/us-east-1", "image_id": "ami-east"},
                {"infra": "aws/us-west-2", "image_id": "ami-west", "labels": {"team": "b"}},
            ],
        }
    }
    west = built(asked, WEST)["resources"]
    assert (west["image_id"], west["disk_size"], west["labels"]["team"]) == ("ami-west", 50, "b")
    assert built(asked, EAST)["resources"]["image_id"] == "ami-east"


def test_an_on_demand_stand_in_keeps_what_its_spot_alternative_asks_for():
    east, west = ({"infra": f"aws/{region}"} for region in ("us-east-1", "us-west-2"))
    spot = {"image_id": "ami-west", "disk_size": 50, "use_spot": True}
    asked = {"resources": {"any_of": [east, {**west, **spot}]}}
    stand_in = built(asked, replace(WEST, spot=False))["resources"]
    assert {key: stand_in[key] for key in spot} == {**spot, "use_spot": False}
    asked["resources"]["any_of"].append({**west, "image_id": "ami-on-demand"})
    assert built(asked, replace(WEST, spot=False))["resources"]["image_id"] == "ami-on-demand"
    assert built(asked, WEST)["resources"]["image_id"] == "ami-west"


def test_of_several_alternatives_that_fit_the_most_precise_counts():
    anywhere, there = {"infra": "aws", "disk_size": 50}, {"infra": "aws/us-west-2", "disk_size": 60}
    named = {"infra": "aws", "instance_type": WEST.instance, "disk_size": 70}
    for asked, size in (([anywhere, there], 60), ([anywhere, there, named], 70)):
        assert built({"resources": {"any_of": asked}}, WEST)["resources"]["disk_size"] == size


def test_alternatives_in_one_place_may_differ_by_the_machine_only():
    there, big = {"infra": "aws/us-east-1", "cpus": "2+"}, {"cpus": "8+", "accelerators": "L4"}
    both = {"resources": {"any_of": [there, {**there, **big}]}}
    task.check(both)
    both["resources"]["any_of"][1]["image_id"] = "ami-gpu"
    with pytest.raises(SpecError, match=r"resources.any_of\[1\]: differs .* same place"):
        task.check(both)
    both["resources"]["any_of"][1]["instance_type"] = "g6.2xlarge"
    task.check(both)


def test_accelerators_that_the_instance_type_does_not_imply_are_named():
    place = Placement("gcp", "us-west1", "us-west1-a", "n1-standard-8+T4:1")
    resources = built({"resources": {"accelerators": {"T4": 1, "L4": 1}}}, place)["resources"]
    assert (resources["instance_type"], resources["accelerators"]) == ("n1-standard-8", "T4:1")


def test_files_of_the_user_are_kept_beside_those_of_fogft():
    """Their paths are absolute by now; buckets and repositories are left alone."""
    mounts = {"/models": "/home/ann/models", "/data": "s3://bucket", "/b": {"name": "x"}}
    made = built({"workdir": "/home/ann/pool", "file_mounts": mounts})
    assert made["workdir"] == "/home/ann/pool"
    assert mounts.items() <= made["file_mounts"].items()
    assert made["file_mounts"]["~/.fogft/replica"] == "/state/files"
    assert made["file_mounts"]["~/.fogft/wheel"] == "/state/wheel"
    git = {"url": "https://example.org/x.git", "ref": "main"}
    assert built({"workdir": git})["workdir"] == git


@pytest.mark.parametrize(
    ("asked", "key"),
    [
        ({"resources": {"ports": 80}}, "resources.ports"),
        ({"resources": {"autostop": 5}}, "resources.autostop"),
        ({"resources": {"any_of": [{"job_recovery": "x"}]}}, r"resources.any_of\[0\].job_recovery"),
        ({"resources": {"ordered": [{}, {"infra": "k8s/x"}]}}, r"resources.ordered\[1\]"),
        ({"resources": {"cloud": "Kubernetes"}}, "resources"),
        ({"resources": {"labels": {"fogft-pool": "x"}}}, "resources.labels.fogft-pool"),
        ({"file_mounts": {"~/.fogft/replica": "x"}}, "file_mounts"),
        ({"file_mounts": {"~/a/../.fogft": "x"}}, "file_mounts"),
    ],
)
def test_what_a_pool_decides_itself_is_refused_by_name(asked: dict[str, Any], key: str):
    with pytest.raises(SpecError, match=f"^{key}"):
        built(asked)


def test_a_single_node_is_what_a_pool_means_anyway():
    assert "num_nodes" not in built({"num_nodes": 1})


def test_a_replica_that_dials_out_opens_no_port():
    """Nor does it listen where another machine could reach it."""
    made = built({"resources": {"infra": "aws"}}, dials_out=True)
    assert "ports" not in made["resources"]
    assert "--listen 127.0.0.1:7448 " in made["run"]
    assert "--listen 0.0.0.0:7448 " in built({})["run"]


def test_no_mark_of_the_template_is_left():
    made = built({"setup": "colcon build"})
    assert "@" not in made["setup"].replace("colcon build", "") + made["run"]


def test_only_fogfts_own_folder_cannot_be_mounted():
    task.refuse_what_cannot_be_honoured({"file_mounts": {"~/.fogft-data": "/d"}})
    for target in ("~/.fogft", "~/.fogft/", "~/x/../.fogft/replica"):
        with pytest.raises(SpecError, match="own folder"):
            task.refuse_what_cannot_be_honoured({"file_mounts": {target: "/d"}})


def test_the_order_is_not_changed_by_building_it():
    asked = {"resources": {"labels": {"a": "b"}}, "file_mounts": {"/m": "m"}}
    before = repr(asked)
    built(asked)
    assert repr(asked) == before


# -- the scripts, run by a real shell ---------------------------------------------------------


def test_setup_of_the_pool_file_is_taken_as_it_is():
    """No mark inside it is replaced, and no character of it is special to the template."""
    text = "echo '@PORT@ $HOME @FILES@'\ncat <<'X'\n) || exit 0 #\nX"
    assert text in built({"setup": text})["setup"]


@pytest.fixture
def vm(tmp_path: Path) -> Path:
    """A home as on a VM on which fogft is installed already."""
    (tmp_path / ".fogft/venv/bin").mkdir(parents=True)
    fogft = tmp_path / ".fogft/venv/bin/fogft"
    fogft.write_text('#!/bin/sh\necho "fogft $*"\n')
    fogft.chmod(0o755)
    (tmp_path / ".fogft/venv/bin/python").symlink_to(sys.executable)
    (tmp_path / ".fogft/venv/bin/activate").touch()
    (tmp_path / ".fogft/replica").mkdir(mode=0o755)
    (tmp_path / ".fogft/replica/replica.key").write_text("secret")
    return tmp_path


def shell(home: Path, script: str, **environ: str) -> subprocess.CompletedProcess[str]:
    """Run a script as SkyPilot does: its shells are interactive, so know of stopped children."""
    file, outer = home / "script", home / "outer-script"
    file.write_text(script)
    outer.write_text(f"bash --norc -i {file}\n")
    return subprocess.run(
        ["bash", "--norc", "-i", outer],
        cwd=home,
        env={
            "HOME": str(home),
            "PATH": "/usr/local/bin:/usr/bin:/bin",
            "TMPDIR": str(home),  # what is killed leaves its files there
            **environ,
        },
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
        start_new_session=True,  # as SkyPilot does
    )


def test_setup_runs_the_users_part_and_hides_the_key(vm: Path):
    done = shell(vm, built({"setup": "false\ntouch ran\nexit 0"})["setup"])
    assert done.returncode == 0, done.stderr
    assert (vm / "ran").exists()
    assert (vm / ".fogft/replica/replica.key").stat().st_mode & 0o077 == 0


def wheel_of(folder: Path, name: str, version: str, requires: str = "", extra: str = "") -> None:
    """Write a wheel of one module, and of one program of its name that shows what it finds."""
    info = f"{name}-{version}.dist-info"
    metadata = f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\nProvides-Extra: ros\n"
    metadata += f"Requires-Dist: {requires}\n" if requires else ""
    metadata += f'Requires-Dist: {extra}; extra == "ros"\n' if extra else ""
    files = {
        f"{name}.py": f"version = {version!r}\n\ndef main():\n    import userlib\n"
        "    print('the proxy finds', userlib.version)\n",
        f"{info}/METADATA": metadata,
        f"{info}/WHEEL": "Wheel-Version: 1.0\nRoot-Is-Purelib: true\nTag: py3-none-any\n",
        f"{info}/entry_points.txt": f"[console_scripts]\n{name} = {name}:main\n",
        f"{info}/RECORD": "",
    }
    folder.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(folder / f"{name}-{version}-py3-none-any.whl", "w") as archive:
        for path, text in files.items():
            archive.writestr(path, text)


@pytest.fixture
def new_vm(tmp_path: Path) -> Path:
    """A home as on a VM that was just made, with SkyPilot's environment and an index of wheels."""
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", tmp_path / "sky-user-env"],
                   check=True)  # fmt: skip
    for version in ("1.0", "2.0"):
        wheel_of(tmp_path / "index", "userlib", version)
    wheel_of(tmp_path / "index", "rclpy", "7.1")
    return tmp_path


def make_environments_quickly(python: Path, other: Path) -> None:
    """Have a Python make environments whose pip is the tests' own: its own takes seconds.

    Args:
        python: The program that makes them.
        other: Where the program itself goes.
    """
    python.rename(other)
    python.write_text(
        f'#!/bin/sh\nset -e\n[ "$1 $2" = "-m venv" ] || exec {other} "$@"\n'
        f'{other} -m venv --without-pip "$3" "$4"\n'
        f'ln -s {Path(pip.__file__).parent} "$(echo "$4"/lib/python*/site-packages)"\n'
        'printf \'#!/bin/sh\\nexec %s/bin/python -m pip "$@"\\n\' "$4" >"$4/bin/pip"\n'
        'chmod +x "$4/bin/pip"\n'
    )
    python.chmod(0o755)


@pytest.fixture
def quick_vm(new_vm: Path) -> Path:
    """The same, where it takes no seconds to make fogft's environment."""
    programs = new_vm / "sky-user-env/bin"
    make_environments_quickly(programs / "python3", programs / "python-itself")
    return new_vm


def on_skypilot(home: Path, script: str) -> subprocess.CompletedProcess[str]:
    """Run a script as SkyPilot does: with its own environment active."""
    script = with_ros_at(home / "no-ros", script)
    index = {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(home / "index")}
    return shell(home, f". ~/sky-user-env/bin/activate\n{script}", **index)


@pytest.mark.timeout(300)
def test_what_setup_installs_with_pip_is_there_for_run_and_for_the_server_proxy(new_vm: Path):
    """And it keeps its version, where fogft would do with a newer one."""
    wheel_of(new_vm / ".fogft/wheel", "fogft", "0.1.0", requires="userlib>=1", extra="rclpy")
    asked = {"setup": "set -e\npip install -q userlib==1.0\npython3 -c 'import userlib'"}
    done = on_skypilot(new_vm, built(asked)["setup"])
    assert done.returncode == 0, done.stdout + done.stderr
    run = built(asked)["run"]
    seen = "python3 -c 'import rclpy, userlib; print(\"run finds\", userlib.version)'\nexec ~/"
    done = on_skypilot(new_vm, run.replace("exec ~/", seen))
    assert done.stdout.splitlines() == ["run finds 1.0", "the proxy finds 1.0"], done.stderr


@pytest.fixture
def conda(new_vm: Path) -> Path:
    """What SkyPilot's images with conda have: a Python of its own, active in every shell.

    Stands in for Miniforge: this test's Python, copied, with one package that conda has brought.
    """
    root, base = new_vm / "miniconda3", Path(sys.base_prefix)
    library = root / "lib" / f"python{sys.version_info[0]}.{sys.version_info[1]}"
    (root / "bin").mkdir(parents=True)
    shutil.copy(Path(sys.executable).resolve(), root / "bin/python3")
    library.mkdir(parents=True)
    for entry in (base / "lib" / library.name).iterdir():
        if entry.name not in ("site-packages", "dist-packages"):
            (library / entry.name).symlink_to(entry)
    for name in ("site-packages", "dist-packages"):  # Debian's Python looks into the other one
        (library / name).mkdir()
        (library / name / "condalib.py").write_text("version = '3.0'\n")
    make_environments_quickly(root / "bin/python3", root / "bin/python-itself")
    return root


def test_on_an_image_with_conda_run_has_what_conda_and_pip_brought(new_vm: Path, conda: Path):
    """SkyPilot leaves its own environment aside where conda's is active."""
    wheel_of(new_vm / ".fogft/wheel", "fogft", "0.1.0", requires="userlib>=1", extra="rclpy")
    active = f"export CONDA_PREFIX={conda} PATH={conda}/bin:/usr/bin:/bin\n"
    asked = {"setup": "set -e\npython3 -c 'import condalib'\npip install -q userlib==1.0"}
    index = {"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(new_vm / "index")}
    setup = with_ros_at(new_vm / "no-ros", built(asked)["setup"])
    done = shell(new_vm, active + setup, **index)
    assert done.returncode == 0, done.stdout + done.stderr
    seen = "python3 -c 'import condalib, rclpy, userlib; print(userlib.version)'\nexec ~/"
    run = with_ros_at(new_vm / "no-ros", built(asked)["run"]).replace("exec ~/", seen)
    done = shell(new_vm, active + run)
    assert done.stdout.splitlines() == ["1.0", "the proxy finds 1.0"], done.stderr


def lock(home: Path, **versions: str) -> None:
    """Write the lock for a machine without ROS 2: these wheels of the index, with their hashes."""
    entries = []
    for name, version in versions.items():
        content = (home / f"index/{name}-{version}-py3-none-any.whl").read_bytes()
        entries.append(f"{name}=={version} ; python_version >= '3.10' \\\n"
                       f"    --hash=sha256:{hashlib.sha256(content).hexdigest()}\n")  # fmt: skip
    (home / ".fogft/replica").mkdir(parents=True, exist_ok=True)
    (home / ".fogft/replica/requirements-ros.txt").write_text("".join(entries))


def installed(home: Path) -> dict[str, str]:
    """Return what is in a machine's environment, by name."""
    words = [home / ".fogft/venv/bin/python", "-m", "pip", "list", "--local", "--format", "json"]
    done = subprocess.run(words, capture_output=True, check=True)
    return {one["name"]: one["version"] for one in json.loads(done.stdout)}


@pytest.mark.parametrize("first", ["", "pip install -q userlib==2.0"])
def test_what_fogft_needs_comes_from_the_lock_but_for_what_setup_brought(
    quick_vm: Path, first: str
):
    """In the lock's version, be there a newer one; nothing is asked for that is not in it."""
    wheel_of(quick_vm / ".fogft/wheel", "fogft", "0.1.0", requires="userlib>=1", extra="rclpy")
    lock(quick_vm, userlib="1.0", rclpy="7.1")
    done = on_skypilot(quick_vm, built({"setup": first})["setup"])
    assert done.returncode == 0, done.stdout + done.stderr
    found = installed(quick_vm)
    assert (found["userlib"], found["rclpy"]) == ("2.0" if first else "1.0", "7.1")
    assert "fogft" in found
    (told,) = [line for line in done.stdout.splitlines() if "is not locked" in line]
    assert ("userlib==2.0" in told) == bool(first)


def test_a_file_that_the_lock_does_not_name_is_not_installed(quick_vm: Path):
    wheel_of(quick_vm / ".fogft/wheel", "fogft", "0.1.0", requires="userlib>=1")
    lock(quick_vm, userlib="1.0", rclpy="7.1")
    wheel_of(quick_vm / "index", "userlib", "1.0", requires="evil")
    done = on_skypilot(quick_vm, built({})["setup"])
    assert done.returncode != 0
    assert "DO NOT MATCH THE HASHES" in done.stderr + done.stdout
    assert not (quick_vm / ".fogft/venv/bin/fogft").exists()


def test_a_version_that_does_not_go_with_fogft_is_told(quick_vm: Path):
    wheel_of(quick_vm / ".fogft/wheel", "fogft", "0.1.0", requires="userlib>=2")
    done = on_skypilot(quick_vm, built({"setup": "pip install -q userlib==1.0"})["setup"])
    assert done.returncode != 0
    assert "what `setup` has installed does not go with what fogft needs" in done.stdout
    assert "userlib==1.0" in done.stdout
    assert not (quick_vm / ".fogft/venv/bin/fogft").exists()


def test_a_machine_without_a_python_of_today_is_told(new_vm: Path):
    old = new_vm / "bin/python3"
    old.parent.mkdir()
    old.write_text("#!/bin/sh\nexit 1\n")
    old.chmod(0o755)
    (new_vm / ".fogft").mkdir()
    script = with_ros_at(new_vm / "no-ros", built({})["setup"])
    for word in ("/usr/bin/python3 ", "python3.13", "python3.12", "python3.11", "python3.10"):
        script = script.replace(word, "python3 ")
    done = shell(new_vm, script, PATH=f"{old.parent}:/usr/bin:/bin")
    assert done.returncode != 0
    assert "there is no Python 3.10 to 3.13" in done.stdout


WORKSPACE = template_files.read_text("workspace.sh")
PACKAGE = """\
<package format="3"><name>greet</name><version>0.0.1</version><description>none</description>
<maintainer email="a@b.c">a</maintainer><license>MIT</license>
<export><build_type>cmake</build_type></export></package>
"""


@needs("colcon")
@pytest.mark.parametrize("setup", ["colcon build --base-paths src", WORKSPACE])
def test_a_workspace_that_was_built_elsewhere_is_built_anew(vm: Path, setup: str):
    """CMake refuses a cache of another folder; what was built here before stays."""
    lab = vm / "lab/src/greet"
    lab.mkdir(parents=True)
    (lab / "package.xml").write_text(PACKAGE)
    (lab / "CMakeLists.txt").write_text(
        "cmake_minimum_required(VERSION 3.16)\nproject(greet NONE)\n"
        "install(FILES package.xml DESTINATION share/greet)\n"
    )
    path = f"{Path(sys.executable).parent}:/usr/local/bin:/usr/bin:/bin"
    done = shell(vm, "cd lab && colcon build --base-paths src", PATH=path)
    assert done.returncode == 0, done.stderr
    shutil.copytree(vm / "lab", vm / "sky_workdir")
    for folder in ("install", "log"):
        shutil.rmtree(vm / "sky_workdir" / folder)
    script = f"cd ~/sky_workdir\n{built({'setup': setup})['setup']}"
    for setting_up in ("on a new machine", "again"):
        (vm / "sky_workdir/build" / setting_up).touch()
        done = shell(vm, script, PATH=path)
        assert done.returncode == 0, done.stderr
        assert "different" not in done.stderr + done.stdout
        cache = (vm / "sky_workdir/build/greet/CMakeCache.txt").read_text()
        assert f"CMAKE_HOME_DIRECTORY:INTERNAL={vm}/sky_workdir/src/greet" in cache
        assert (vm / "sky_workdir/build" / setting_up).exists() == (setting_up == "again")


def test_a_failing_setup_of_the_pool_file_fails_the_whole(vm: Path):
    done = shell(vm, built({"setup": "echo before\nexit 3"})["setup"])
    assert done.returncode != 0
    assert "the pool file's setup failed" in done.stdout


HANGING = """\
setsid sleep 86400 &
echo $! > ~/apart
sleep 86400 & sleep 86400
touch ~/went-on
"""


def test_a_hanging_setup_is_ended_by_the_machine_itself(vm: Path):
    """No manager is needed; what it started is killed too, a session of its own included.

    `shell` returns only when nobody holds the pipe any more, as SkyPilot does.
    """
    script = built({"setup": HANGING})["setup"]
    limit = f"read -rt {SETUP_LIMIT_S} "
    assert limit in script
    begun = "until [ -s ~/apart ]; do sleep 0.1; done; read -rt 0.1 "
    done = shell(vm, script.replace(limit, begun))
    assert done.returncode != 0
    assert "the set-up took more than 3600 s" in done.stdout
    assert not (vm / "went-on").exists()
    apart = int((vm / "apart").read_text())
    wait_for(lambda: not processes.alive(apart))


def test_what_a_hanging_setup_is_just_starting_is_killed_too(tmp_path: Path):
    """Whenever the limit strikes: what it starts in that moment has no parent to find it by."""

    def hang(n: int) -> subprocess.CompletedProcess[str]:
        home = tmp_path / str(n)
        (home / ".fogft").mkdir(parents=True)
        limit = f"read -rt {SETUP_LIMIT_S} "
        return shell(home, script.replace(limit, f"read -rt {0.001 * (n + 1):.3f} "))

    script = built({"setup": HANGING})["setup"]
    with ThreadPoolExecutor(8) as several:
        ended = list(several.map(hang, range(32)))
    assert all("it is ended" in one.stdout and one.returncode != 0 for one in ended)


def test_a_setup_that_ends_in_time_leaves_no_guard_behind(vm: Path):
    """It would hold the pipe for an hour, and the job with it."""
    done = shell(vm, built({"setup": "true"})["setup"])
    assert done.returncode == 0, done.stderr
    assert "took more than" not in done.stdout


@pytest.fixture
def bare_vm(vm: Path) -> Path:
    """A home as on a VM that was just made: the wheel came, and SkyPilot brought `uv`."""
    shutil.rmtree(vm / ".fogft/venv")
    (vm / ".fogft/wheel").mkdir()
    (vm / ".fogft/wheel/fogft-0.1.0-py3-none-any.whl").touch()
    (vm / ".local/bin").mkdir(parents=True)
    uv = vm / ".local/bin/uv"
    uv.write_text(
        '#!/bin/sh\necho "uv $*" >> ~/uv-calls\nmkdir -p ~/.fogft/venv/bin\n'
        'echo "PATH=$HOME/.fogft/venv/bin:$PATH" > ~/.fogft/venv/bin/activate\n'
        f"ln -sf {sys.executable} ~/.fogft/venv/bin/python\n"
    )
    uv.chmod(0o755)
    return vm


def with_ros_at(folder: Path, script: str) -> str:
    """Return a script that looks for ROS 2 in another folder than /opt/ros."""
    assert "/opt/ros" in script
    return script.replace("/opt/ros", str(folder))


def test_plain_ubuntu_gets_ros_with_the_wheel(bare_vm: Path, tmp_path: Path):
    done = shell(bare_vm, with_ros_at(tmp_path / "no-ros", built({})["setup"]))
    assert done.returncode == 0, done.stderr
    made, installed = (bare_vm / "uv-calls").read_text().splitlines()
    assert made.startswith("uv venv --quiet --seed --system-site-packages ")
    assert installed.endswith("/.fogft/wheel/fogft-0.1.0-py3-none-any.whl[ros]")


def test_an_image_with_ros_keeps_its_own(bare_vm: Path, tmp_path: Path):
    """Sourced, so that `rclpy` is found; the wheel then brings none."""
    ros = tmp_path / "ros/kilted"
    (ros / "lib/rclpy").mkdir(parents=True)
    (ros / "lib/rclpy/__init__.py").touch()
    (ros / "setup.bash").write_text(f"export PYTHONPATH={ros}/lib ROS_DISTRO=kilted\n")
    done = shell(bare_vm, with_ros_at(tmp_path / "ros", built({})["setup"]))
    assert done.returncode == 0, done.stderr
    made, installed = (bare_vm / "uv-calls").read_text().splitlines()
    assert installed.endswith("/.fogft/wheel/fogft-0.1.0-py3-none-any.whl")
    if Path("/usr/bin/python3").exists():  # the one that ROS 2 was built for
        assert "--python /usr/bin/python3 " in made


@pytest.mark.parametrize(
    ("given", "found"),
    [({}, "LOCALHOST"), ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "SUBNET")],
)
def test_ros_speaks_to_its_own_machine_unless_told(vm: Path, given: dict[str, str], found: str):
    fogft = vm / ".fogft/venv/bin/fogft"
    fogft.write_text('#!/bin/sh\necho "$ROS_AUTOMATIC_DISCOVERY_RANGE"\n')
    done = shell(vm, built({})["run"], **given)
    assert done.stdout.strip() == found


def test_run_becomes_the_server_proxy(vm: Path):
    """The user's `run` is the server proxy's child, never SkyPilot's, and waits behind nobody."""
    made = built({"run": "python3 serve.py"})
    assert "serve.py" not in made["run"]
    (vm / ".fogft/venv/bin/fogft").write_text('#!/bin/sh\necho "fogft $*"; nice\n')
    done = shell(vm, "renice -n 19 -p $$ >/dev/null\n" + made["run"])
    may = not subprocess.run(["nice", "-n", "-1", "true"], check=True, capture_output=True).stderr
    assert done.stdout.split() == [
        *("fogft", "serve", "--config", f"{vm}/.fogft/replica/replica.yaml"),
        *("--listen", "0.0.0.0:7448", "--workdir", str(vm), "0" if may else "19"),
    ]
