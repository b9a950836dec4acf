"""What a sweep runs: particles × seeds × sequences × options, from a YAML file.

system: range-bearing
sequences: [log, other_log]            # beside this file; or {recording: IMAGES, known_points: FILE}
particles: [50, 250]                   # by default the system's own number
seeds: 5                               # 0 … 4; or a list
options:                               # by default one, as it is
as it is: {}
one linearisation: {proposal.iterations: 1}
settings: {anchor_every: 10}           # of all runs
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Any

import msgspec

from rbpf import __version__
from rbpf.errors import InputError
from rbpf.sensors.readers.yaml_files import read_plain_yaml
from rbpf.validation.sweep.systems import system_named

MOST_RUNS = 100_000

Value = str | int | float | bool | None


@dataclass(frozen=True)
class SweepFile:
    """What the YAML file holds."""

    system: str  #: which one is run.
    sequences: list[str | dict[str, str]]  #: paths, or mappings of the system's fields to paths.
    particles: list[int] = field(default_factory=list)  #: numbers of particles; empty for the system's own.
    seeds: int | list[int] = 1  #: how many, or which.
    #: by a name, settings by theirs.
    options: dict[str, dict[str, Value]] = field(default_factory=lambda: {"as it is": {}})
    settings: dict[str, Value] = field(default_factory=dict)  #: of all runs.


@dataclass(frozen=True)
class Job:
    """One run of a sweep."""

    system: str  #: which one.
    sequence: tuple[tuple[str, str], ...]  #: the system's fields and their paths, as (name, path).
    option: str  #: name of the option.
    settings: tuple[str, ...]  #: as key=value, the option's after those of all runs.
    particles: int | None  #: how many; None for the system's own.
    seed: int  #: of the filter.

    @property
    def key(self) -> str:
        """Name of the run that does not change from one call of the program to the next."""
        facts = [__version__, self.system, self.sequence, self.settings, self.particles, self.seed]
        return hashlib.sha256(json.dumps(facts).encode()).hexdigest()[:16]

    @property
    def given(self) -> dict[str, int]:
        """Settings by name."""
        return ({} if self.particles is None else {"particles": self.particles}) | {"seed": self.seed}

    def facts(self) -> dict[str, Any]:
        """The first columns of its row in the table."""
        recording = dict(self.sequence)["recording"]
        return {"system": self.system, "sequence": recording, "option": self.option, **self.given}


def read_plan(path: Path) -> list[Job]:
    """All runs of a sweep, checked before the first one starts.

    Raises:
        InputError: the file is unreadable, names something unknown, or a sequence is not there.
    """
    return plan(_converted(path, read_plain_yaml(path)), path.parent, str(path))


def plan(file: SweepFile, folder: Path, where: str = "the sweep") -> list[Job]:
    """All runs of a sweep; paths are taken from a folder. Errors as `read_plan`."""
    system = system_named(file.system)
    sequences = [_sequence(given, system.fields, folder, where) for given in file.sequences]
    seeds: Sequence[int] = range(file.seeds) if isinstance(file.seeds, int) else file.seeds  # a range takes no room
    for what, values in (("sequences", sequences), ("seeds", seeds), ("options", list(file.options))):
        if not values:
            raise InputError(f"{where}: {what} is empty, name at least one")
    sizes: list[int | None] = list(file.particles) or [None]
    if len(sequences) * len(sizes) * len(seeds) * len(file.options) > MOST_RUNS:
        raise InputError(f"{where} asks for more than {MOST_RUNS} runs: ask for fewer")
    settings = {
        name: tuple(f"{key}={'null' if value is None else value}" for key, value in (file.settings | option).items())
        for name, option in file.options.items()
    }
    jobs = [
        Job(file.system, sequence, name, settings[name], particles, seed)
        for sequence, name, particles, seed in product(sequences, file.options, sizes, seeds)
    ]
    for job in {(job.option, job.particles): job for job in jobs}.values():
        try:
            system.check(job.settings, job.given)
        except InputError as error:
            raise InputError(f"{where}, option {job.option!r}: {error}") from error
    if len({job.key for job in jobs}) < len(jobs):
        raise InputError(f"{where} asks for the same run twice: two options, seeds or sequences are alike")
    return jobs


def _converted(path: Path, values: Any) -> SweepFile:
    if not isinstance(values, dict):
        raise InputError(f"{path} must hold system, sequences, … as `name: value`, one per line")
    known = SweepFile.__dataclass_fields__
    unknown = sorted(str(name) for name in values if name not in known)
    if unknown:
        raise InputError(f"{path}: there is no entry {unknown[0]!r} in a sweep; known here: {', '.join(known)}")
    try:
        return msgspec.convert(values, SweepFile)
    except msgspec.ValidationError as error:
        raise InputError(f"{path}: {error}") from error


def _sequence(
    given: str | Mapping[str, str], fields: tuple[str, ...], folder: Path, where: str
) -> tuple[tuple[str, str], ...]:
    named = {"recording": given} if isinstance(given, str) else dict(given)
    wrong = sorted(set(named) - set(fields))
    if wrong or "recording" not in named:
        raise InputError(f"{where}: a sequence has the entries {', '.join(fields)}, got {', '.join(named)}")
    paths = {name: folder / path for name, path in named.items()}
    for path in paths.values():
        if not path.exists():
            raise InputError(f"{where}: there is no sequence {path}")
    return tuple((name, str(path.resolve())) for name, path in sorted(paths.items()))
