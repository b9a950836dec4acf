"""Provenance of a run: config.yaml with versions, settings and a digest of the input, to repeat it."""

import hashlib
import json
import platform
import re
from collections.abc import Mapping
from contextlib import suppress
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import yaml

from rbpf import __version__
from rbpf.errors import InputError
from rbpf.runs.files import holds_run, write_text
from rbpf.sensors.readers.yaml_files import read_plain_yaml
from rbpf.systems.settings import HEADER

CONFIG = "config.yaml"
LIBRARIES = "numpy", "scipy", "numba", "opencv-python-headless"  #: Libraries whose version may change a run's results.
INPUTS = "recording", "known_points", "calibration", "known_map"  #: Entries that name input files or folders.
_FLAGS = ("localize",)
_OUTPUTS = "video", "batch"  #: Optional outputs of a run.
_HEAD = "rbpf", "system", "versions", "input_sha256", "recording"
_INSTRUCTIONS = "sse4.2", "avx", "avx2", "fma", "avx512f", "neon", "sve"
#: Settings that do not affect the results, and may differ on resuming; all others must be equal.
FREE = ("checkpoint_every",)


def read_config(folder: Path) -> dict[str, Any]:
    """The entries of a run folder's config.yaml. Raises InputError: it is no run folder."""
    path = folder / "config.yaml"
    if not path.exists():
        raise InputError(f"{folder} holds no config.yaml: expected the folder that `rbpf run` leaves.")
    config = read_plain_yaml(path)
    if not isinstance(config, dict) or "rbpf" not in config or "system" not in config:
        raise InputError(f"{path}: expected the settings of a run with its version and system, found other content.")
    return {str(name): value for name, value in config.items()}


def require_own_version(config: Mapping[str, Any], folder: Path) -> None:
    """Raises InputError: the run is of another version (except patch), whose settings or files may differ in meaning."""
    if str(config["rbpf"]).split(".")[:2] != __version__.split(".")[:2]:
        written = f"{folder} was written by rbpf {config['rbpf']}, this is {__version__}"
        raise InputError(f"{written}; run again with --config {folder / CONFIG}.")


def write_config(out: Path, system: str, sources: Mapping[str, Any], settings: Mapping[str, Any]) -> None:
    """Writes config.yaml: everything that is needed to repeat a run; `recording` is one of its sources."""
    digest = digest_of({name: Path(str(sources[name])) for name in INPUTS if name in sources}, out)
    head = {"rbpf": __version__, "system": system, **sources}
    if digest is not None:
        head["input_sha256"] = digest
    # Python, numerical libraries, and the processor's instruction sets.
    versions = {"python": platform.python_version(), "instructions": instruction_set()}
    for name in LIBRARIES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    write_text(out / CONFIG, yaml.safe_dump({**head, "versions": versions, **settings}, sort_keys=False))


def instruction_set() -> str:
    """The processor, and its vector instruction sets, on which the rounding of sums depends."""
    import numba
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    found = [name for name in _INSTRUCTIONS if features.get(name)]
    return " ".join([numba.config.CPU_NAME or binding.get_host_cpu_name(), *found])


def digest_of(sources: Mapping[str, Path], without: Path | None = None) -> str | None:
    """SHA-256 over names and contents of all input files; None if one is missing.

    The folder `without`, such as the run's own, and other runs' folders inside a recording are excluded.
    """
    whole = hashlib.sha256()
    for name, path in sorted(sources.items()):
        if not path.exists():
            return None
        whole.update(f"{name}\n".encode())
        inside, own = sorted(path.rglob("*")), None if without is None else without.resolve()
        runs = {place for place in inside if place.is_dir() and (holds_run(place) or place.resolve() == own)}
        files = [path] if path.is_file() else [f for f in inside if f.is_file() and runs.isdisjoint(f.parents)]
        for file in files:
            relative = "" if path.is_file() else file.relative_to(path).as_posix()
            whole.update(f"{relative}\n{file.stat().st_size}\n".encode())
            try:
                with file.open("rb") as content:
                    hashlib.file_digest(content, lambda: whole)
            except OSError as error:
                raise InputError(f"{file} cannot be read: {error.strerror}") from error
    return whole.hexdigest()


def decisive_settings(settings: Mapping[str, Any]) -> dict[str, str]:
    """Settings that decide the results, as JSON text by name, those of groups with dots; without `FREE`."""
    found: dict[str, str] = {}
    for name, value in settings.items():
        if isinstance(value, Mapping):
            found |= {f"{name}.{inner}": text for inner, text in decisive_settings(value).items()}
        elif name not in FREE:
            found[name] = json.dumps(value, default=str)
    return found


def decisive_inputs(sources: Mapping[str, Any], out: Path) -> dict[str, str]:
    """A run's inputs (`sources`), as text by name: digests of files, regardless of their names, and all else as given.

    A recording that is itself the run's folder `out` changes with the run, and is left out.
    """
    found: dict[str, str] = {}
    for name, value in sources.items():
        path = Path(str(value))
        if name not in INPUTS:
            found[name] = json.dumps(value)
        elif path.resolve() != out.resolve():
            digest = digest_of({name: path}, out)
            found[name] = f"{value}" if digest is None else f"content of SHA-256 {digest}"
    return found


def require_same(path: Path, before: Mapping[str, str], now: Mapping[str, str]) -> None:
    """Raises InputError: a run (`path` is its checkpoint) is resumed with other inputs; names the first difference."""
    for name in [*before, *(name for name in now if name not in before)]:
        if before.get(name) != now.get(name):
            # Digests are cut short.
            values = (side.get(name, "nothing") for side in (before, now))
            was, given = (f"{v[:31]}…" if v.startswith("content of SHA-256 ") else v for v in values)
            raise InputError(
                f"{path} belongs to a run with {name} = {was}, this one has {given}: go on with the same settings and "
                "the same recording, or start without --resume"
            )


def read_origin(config: Path) -> list[str]:
    """System, recording and options that a run was started with, from its config.yaml or the folder of it.

    Raises InputError: an input has changed or is missing.
    """
    if config.is_dir():
        config = config / CONFIG
    if config.name != CONFIG:
        raise InputError(f"{config}: expected the {CONFIG} that a run left in its folder")
    entries = read_config(config.parent)
    require_own_version(entries, config.parent)
    if "recording" not in entries:
        raise InputError(f"{config} names no recording: it is no run's, give it with --config instead")
    files = {name: Path(str(entries[name])) for name in INPUTS if name in entries}
    for name, path in files.items():
        if not path.exists():
            raise InputError(f"{config}: its {name} {path} is not there: repeat from the folder the run was started in")
    if "input_sha256" in entries and digest_of(files, config.parent) != entries["input_sha256"]:
        raise InputError(
            f"{entries['recording']} has changed since the run of {config}; to use its settings alone give --config"
        )
    return [str(entries["system"]), str(entries["recording"]), "--config", str(config), *_options(entries)]


def _options(entries: Mapping[str, Any]) -> list[str]:
    """Further options of a run: an entry of config.yaml has the option's name, possibly with a unit."""
    words = list[str]()
    for name in HEADER:
        if name in entries and name not in (*_HEAD, *_FLAGS, *_OUTPUTS):
            option = "map" if name == "known_map" else re.sub(r"_(m|s|px)$", "", name).replace("_", "-")
            words += [f"--{option}", str(entries[name])]
    words += [f"--{name}" for name in _FLAGS if entries.get(name)]
    return words + [f"--no-{name}" for name in _OUTPUTS if entries.get(name) is False]


def command_of(entries: Mapping[str, Any], *defaults: Mapping[str, Any]) -> list[str]:
    """The command of a run by its config.yaml, with all non-default settings."""
    words = ["rbpf", "run", str(entries["system"]), str(entries.get("recording", "RECORDING")), *_options(entries)]
    own = decisive_settings({name: value for name, value in entries.items() if name in defaults[0]})
    usual = [decisive_settings(each) for each in defaults]
    for name, value in own.items():
        if any(value != each.get(name) for each in usual):
            value = value.strip('"')
            words += [f"--{name}", value] if name in ("particles", "seed") else ["--set", f"{name}={value}"]
    return words
