"""Run what is missing of an experiment: interleaved, with progress, from where it stopped.

Owns: the order of trials and what a row says of its circumstances.
Not here: the trials themselves (the experiments) and their files (`samples`).
"""

from __future__ import annotations

import contextlib
import os
import random
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from fogft import disk
from tests.evaluation.errors import EvaluationError
from tests.evaluation.experiment import Experiment, Scale, Stage
from tests.evaluation.pools import Pools
from tests.evaluation.samples import Samples, Store

SETTINGS = "settings.json"  # of each experiment: how much was run, and with what
Trial = tuple[str, int]
Advance = Callable[[int, int], None]


def order(trials: Mapping[str, int], seed: int = 0) -> list[Trial]:
    """Return all trials in the order of running.

    Trial k of every condition comes before trial k + 1 of any; within a round the order is
    drawn anew. The same arguments give the same order.
    """
    out: list[Trial] = []
    for number in range(max(trials.values(), default=0)):
        conditions = [condition for condition, count in trials.items() if number < count]
        random.Random(f"{seed}/{number}").shuffle(conditions)
        out += [(condition, number) for condition in conditions]
    return out


def missing(store: Store, trials: Mapping[str, int]) -> list[Trial]:
    """Return the trials without a row, in the order of running."""
    done = {(c, int(row["trial"])) for c in trials for row in store.read(c)}
    return [trial for trial in order(trials) if trial not in done]


def complete(
    experiment: Experiment,
    store: Store,
    scale: Scale,
    options: Mapping[str, str],
    advance: Advance = lambda done, all: None,
    say: Callable[[str], None] = print,
) -> Samples:
    """Run what is missing and return all rows.

    Args:
        experiment: Which.
        store: Its files.
        scale: How much.
        options: Values of its own arguments.
        advance: Told after each trial how many are done, of how many.
        say: Shows a line beside the progress.

    Raises:
        EvaluationError: A trial or its session could not be run. Rows so far are kept.
    """
    trials = experiment.trials(scale)
    all_of_them = sum(trials.values())
    todo = missing(store, trials)
    if experiment.whole and 0 < len(todo) < all_of_them:
        say(f"{experiment.name}: was interrupted and cannot go on in its middle: begins again")
        store.clear()
        todo = order(trials)
    advance(all_of_them - len(todo), all_of_them)
    if todo:
        with _work_folder(store.folder / ".work", say) as folder:
            stage = Stage(scale, options, folder, say)
            _run(experiment, store, stage, todo, all_of_them, advance)
    return store.samples(list(trials))


@contextlib.contextmanager
def _work_folder(folder: Path, say: Callable[[str], None]) -> Iterator[Path]:
    """Make an empty folder for a session, and remove it afterwards.

    Pools that a killed run left in it are ended first.
    """
    if folder.exists():
        say("an earlier run was killed: ending its pools first")
        for home in folder.glob("*/home"):
            Pools(home.parent).close()
        shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def _run(
    experiment: Experiment,
    store: Store,
    stage: Stage,
    todo: Sequence[Trial],
    all_of_them: int,
    advance: Advance,
) -> None:
    with experiment.session(stage) as run:
        for number, (condition, trial) in enumerate(todo):
            circumstances = {"trial": trial, "began_at": round(time.time(), 3)}
            row = run(condition, trial)
            load = round(os.getloadavg()[0], 2)
            store.append(condition, {**circumstances, "load": load, **row})
            advance(all_of_them - len(todo) + number + 1, all_of_them)


def found(into: Path, experiments: Mapping[str, Experiment]) -> dict[str, Samples]:
    """Return the samples of every experiment that is complete in a results folder.

    Each with the scale with which it was run: what an earlier run left counts too.
    """
    out = {}
    for name, experiment in experiments.items():
        settings = disk.read_json(into / name / SETTINGS)
        if settings is None:
            continue
        trials = experiment.trials(Scale(settings["scale"]))
        store = Store(into / name, experiment.fields)
        if not missing(store, trials):
            out[name] = store.samples(list(trials))
    return out


def check_settings(path: Path, settings: Mapping[str, object]) -> None:
    """Hold a results folder to the settings with which it was begun; note them in a new one.

    Raises:
        EvaluationError: It was made with others.
    """
    before = disk.read_json(path)
    if before is None:
        path.parent.mkdir(parents=True, exist_ok=True)
        disk.write_json(path, dict(settings))
    elif before != settings:
        changed = sorted(k for k in {*before, *settings} if before.get(k) != settings.get(k))
        raise EvaluationError(
            f"{path.parent} holds results that were made with other settings "
            f"({', '.join(changed)}); name another folder with --into, or remove it"
        )
