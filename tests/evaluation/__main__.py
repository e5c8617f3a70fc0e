"""``scripts/reproduce``: run the paper's evaluation and write `results/` with its report."""

from __future__ import annotations

import argparse
import importlib.util
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path

from fogft import disk
from fogft.errors import FogftError
from tests.bench import machine
from tests.bench.rig import ROOT
from tests.evaluation import registry, running
from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Experiment, Scale
from tests.evaluation.samples import Store


def main() -> int:
    """Run what the arguments ask for; return the exit status."""
    experiments = {name: registry.load(name) for name in registry.MODULES}
    options = arguments(experiments)
    if options.list:
        for name, experiment in experiments.items():
            print(f"{name:<14}{experiment.title}")
        return 0
    # Before anything of ROS is imported: the asking node is a ROS process like the others.
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    from fogft.ros import environment, memory_tuning

    environment.prepare(os.environ)
    memory_tuning.tune()
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, _interrupt)
    try:
        return reproduce(experiments, options)
    except (EvaluationError, FogftError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted: run the same command again to go on", file=sys.stderr)
        return 130


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def arguments(experiments: Mapping[str, Experiment]) -> argparse.Namespace:
    """Read the command line; experiments' own arguments are among them."""
    parser = argparse.ArgumentParser(prog="scripts/reproduce", description=__doc__.splitlines()[0])
    scale = parser.add_mutually_exclusive_group()
    scale.add_argument("--quick", action="store_true", help="little of each: to see that it runs")
    scale.add_argument("--full", action="store_true", help="as many trials as the paper, and more")
    parser.add_argument("--list", action="store_true", help="print the names, run nothing")
    parser.add_argument(
        "--only", action="append", metavar="NAME", choices=list(experiments), help="repeatable"
    )
    parser.add_argument("--into", type=Path, metavar="DIR", help="where to write; `results`")
    for experiment in experiments.values():
        for name, text in experiment.options.items():
            parser.add_argument(f"--{name}", metavar="PATH", help=f"{experiment.name}: {text}")
    return parser.parse_args()


def reproduce(experiments: Mapping[str, Experiment], options: argparse.Namespace) -> int:
    """Run the chosen experiments, one after the other; write the report after each."""
    from tests.evaluation import progress, report

    scale = Scale("quick" if options.quick else "full" if options.full else "normal")
    into: Path = options.into or ROOT / "results"
    into.mkdir(parents=True, exist_ok=True)
    lock = disk.Lock(into / ".lock")
    if not lock.acquire(wait=False):
        raise EvaluationError(f"another run writes to {into}: wait for it, or use --into")
    status = 0
    chosen = options.only or list(experiments)
    for name in chosen:
        check_modules(experiments[name])
    with progress.Bars() as bars:
        for name in chosen:
            experiment = experiments[name]
            own = own_options(experiment, options)
            running.check_settings(
                into / name / running.SETTINGS, {"scale": scale.name, "options": own}
            )
            try:
                running.complete(
                    experiment,
                    Store(into / name, experiment.fields),
                    scale,
                    own,
                    bars.of(name),
                    bars.say,
                )
            except EvaluationError as error:
                print(f"error: {name}: {error}", file=sys.stderr)
                status = 1
    note_machine(into / "machine.json")
    complete = running.found(into, experiments)
    written = report.write(into, {name: experiments[name] for name in complete}, complete)
    print(f"report: {written}")
    return status


def own_options(experiment: Experiment, options: argparse.Namespace) -> dict[str, str]:
    """Return the values of an experiment's own arguments, those that were given."""
    given = {name: getattr(options, name.replace("-", "_")) for name in experiment.options}
    return {name: str(Path(value).resolve()) for name, value in given.items() if value}


def check_modules(experiment: Experiment) -> None:
    """Check, before hours of work, that what an experiment imports is installed.

    Raises:
        EvaluationError: It is not.
    """
    for module, extra in {"matplotlib": "plot", **experiment.modules}.items():
        if importlib.util.find_spec(module) is None:
            raise EvaluationError(
                f"{experiment.name} needs `{module}`: run scripts/reproduce, which installs it, "
                f"or `pip install 'fogft[{extra}]'`"
            )


def note_machine(path: Path) -> None:
    """Note once on which machine a folder's results were made."""
    if not path.exists():
        disk.write_json(path, machine.describe())


if __name__ == "__main__":
    sys.exit(main())
