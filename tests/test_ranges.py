"""Every number among settings and options has a range, declared at its field; what is beyond is one sentence."""

import math
from dataclasses import asdict, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, get_args, get_type_hints

import pytest

from rbpf.cli import APP, main
from rbpf.cli.running import RUN
from rbpf.cli.simulating import SIMULATE
from rbpf.core.filter import Filter
from rbpf.errors import InputError
from rbpf.lie import SE2
from rbpf.maps.point import Point
from rbpf.maps.store import Pool
from rbpf.motion.odometry import OdometryMotion
from rbpf.ranges import ANY, Range, former_names
from rbpf.sensors.landmark_sensor import NamedLandmarkSensor
from rbpf.sensors.range_bearing import RangeBearing
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.settings import load_settings
from rbpf.systems.stereo.config import StereoConfig

SYSTEMS = {"mono": MonoConfig, "stereo": StereoConfig, "range-bearing": RangeBearingConfig}


def leaves(hint: Any) -> list[Any]:
    """The types and the notes that a type is made of."""
    return [hint, *(leaf for part in get_args(hint) for leaf in leaves(part))] if get_args(hint) else [hint]


def numbers(kind: type, prefix: str = "") -> list[tuple[str, type, Range]]:
    """Every number of a dataclass and of its groups: its dotted name, int or float, and its range."""
    found = []
    hints = get_type_hints(kind, include_extras=True)
    for item in fields(kind):
        parts = leaves(hints[item.name])
        declared = [part for part in parts if isinstance(part, Range)]
        number = next((part for part in parts if part in (int, float)), None)
        if number is not None:
            found.append((prefix + item.name, number, declared[0] if declared else ANY))
        elif is_dataclass(item.default_factory):
            found += numbers(item.default_factory, f"{prefix}{item.name}.")
    return found


def beyond(number: type, allowed: Range) -> list[float]:
    """Numbers below a range and above it."""
    step = 1 if number is int else 1e-6
    low = allowed.gt if allowed.gt >= allowed.ge else allowed.ge - max(step, abs(allowed.ge) * 1e-6)
    high = allowed.lt if allowed.lt <= allowed.le else allowed.le + max(step, abs(allowed.le) * 1e-6)
    found = [low, high][: 1 if math.isinf(high) else 2]
    return [int(value) for value in found] if number is int else found


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_number_that_is_out_of_its_range(system):
    """Through the door that files and --set take; the message has the setting's name, and the value."""
    every = numbers(SYSTEMS[system])
    assert len(every) > 15
    for name, number, allowed in every:
        limits = beyond(number, allowed)
        for value in [*limits, "one", "nan", *(["inf"] if len(limits) > 1 else [])]:
            with pytest.raises(InputError, match=rf"^settings: {name}\b.* got ") as caught:
                load_settings(SYSTEMS[system], system, None, [f"{name}={value}"], {})
            assert "\n" not in str(caught.value)


COMMANDS = [kind for group in (APP, RUN, SIMULATE) for kind in group.kinds.values() if kind not in (RUN, SIMULATE)]


@pytest.mark.parametrize("kind", COMMANDS)
def test_every_number_on_the_command_line_has_a_range(kind):
    free = {"distortion", "fisheye", "baseline_m", "blackout"}  # judged by the camera and the simulation that take them
    assert {name for name, _, allowed in numbers(kind) if allowed == ANY} <= free


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "mono", "images", "--seed", "-1"], "--seed must be a whole number, at least 0"),
        (["run", "stereo", "pairs", "--particles", "1000000000000"], "--particles must be .* at most 10000000, got 1"),
        (["run", "stereo", "pairs", "--batch-limit", "0"], "--batch-limit must be .* at least 1 .*, got 0"),
        (["simulate", "range-bearing", "--out", "log", "--seed", "-1"], "--seed must be"),
        (["compare", "a", "b", "--seeds", "0"], "--seeds must be"),
    ],
)
def test_an_option_that_is_out_of_its_range(capsys, arguments, words):
    assert main(arguments) == 2
    said = capsys.readouterr().err
    with pytest.raises(InputError, match=words):
        raise InputError(said)
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("particles: 3\nseed: 1\nparticles: 4\n", "line 3: particles occurs twice"),
        ("search:\n  noise_px: 3\n  noise_px: 4\n", "line 3: noise_px occurs twice"),
        ("\n".join(" " * depth + "a:" for depth in range(1200)), "line 21: .* nested"),
        ("- " * 400_000, "line 1: .* nested"),
        ("{a: " * 200_000, "line 1: .* nested"),
        ("a: " + "[" * 5000 + "\n", "line 1: .* nested"),
        ("particles: !!python/object/apply:os.system ['touch pwned']\n", "line 1: expected plain values"),
        ("a: &a [x]\nb: [*a, *a]\n", "alias"),
        ("particles: !!timestamp x\n", "does not fit its type"),
        ("particles: 2001-99-99\n", "does not fit its type"),
        ("#" * (2 << 20), "larger than 1 MiB"),
    ],
)
def test_settings_say_a_thing_once_run_nothing_and_unfold_into_nothing(tmp_path, text, words):
    (tmp_path / "config.yaml").write_text(text)
    with pytest.raises(InputError, match=words):
        load_settings(MonoConfig, "mono", tmp_path / "config.yaml", (), {})
    assert not Path("pwned").exists()


@pytest.mark.parametrize(
    ("pair", "words"),
    [
        ("map=all", "settings: map must be auto or joint or particles, got 'all'"),
        ("map.submap=10", "settings: map must be auto or joint or particles, got a group of settings"),
        ("submap=few", "settings: submap must be a whole number or nothing, got a word"),
        (
            "likelihood.kind=x",
            "settings: likelihood.kind must be gaussian or truncated or outliers or student or nothing, got 'x'",
        ),
        ("proposal=ekf", "proposal is a group of settings, of which each is set by itself: proposal.kind, .*"),
    ],
)
def test_what_a_setting_may_be_is_said(pair, words):
    with pytest.raises(InputError, match=f"^{words}$"):
        load_settings(RangeBearingConfig, "range-bearing", None, [pair], {})


def test_memory_is_estimated_before_it_is_taken():
    sensor = NamedLandmarkSensor(RangeBearing(SE2), Point(2))
    with pytest.raises(InputError, match=r"a filter of 10{12} particles would take .* GB of memory, this machine has"):
        Filter(OdometryMotion(SE2), sensor, n=10**12)
    with pytest.raises(InputError, match=r"32 landmarks of 16 numbers in 10{10} particles would take"):
        Pool(16, 10**10)


# Settings that are given go over the system's own defaults, not over those of a group's class.


def test_the_rest_of_a_group_keeps_the_systems_defaults():
    found = load_settings(StereoConfig, "stereo", None, ["likelihood.truncation=9", "sift.length=128"], {})
    assert found.likelihood.kind == "student" != LikelihoodConfig().kind
    assert found.likelihood.truncation == 9.0
    assert found.likelihood.outlier_volume == StereoConfig().likelihood.outlier_volume
    assert found.sift.length == 128 and found.sift.working_scale == 0.5
    found = load_settings(MonoConfig, "mono", None, ["proposal.weights=linearised"], {})
    assert found.proposal.iterations == MonoConfig().proposal.iterations != ProposalConfig().iterations


def test_nothing_given_is_the_default_maps_of_the_particles_own_bring_theirs_and_what_is_set_wins():
    for kind in (MonoConfig, StereoConfig):
        assert asdict(load_settings(kind, "any", None, [], {})) == asdict(kind())
    own = load_settings(StereoConfig, "stereo", None, ["map.kind=particles"], {"particles": 20})
    assert own == replace(StereoConfig.s05(), particles=20) and not own.likelihood.build().normalised
    assert own.likelihood.outlier_volume == StereoConfig().likelihood.outlier_volume
    assert load_settings(StereoConfig, "stereo", None, ["map.window=3"], {}).likelihood.build().normalised


def test_a_group_can_be_nothing():
    found = load_settings(
        StereoConfig, "stereo", None, ["new_landmarks.distinct=0.2"], {"new_landmarks": {"distinct": None}}
    )
    assert found.new_landmarks.distinct is None and found.new_landmarks.patience == 3


def renamed(kind: type, prefix: str = "") -> list[tuple[str, str]]:
    """Every old name of a setting, with the new one, both with their groups."""
    found = [(prefix + old, prefix + new) for old, new in former_names(kind).items()]
    for item in fields(kind):
        if is_dataclass(item.default_factory):
            found += renamed(item.default_factory, f"{prefix}{item.name}.")
    return found


@pytest.mark.parametrize("kind", [MonoConfig, StereoConfig, RangeBearingConfig])
def test_an_old_name_is_refused_with_the_new_one(kind):
    known = asdict(kind())
    for old, new in renamed(kind):
        value = known
        for name in new.split("."):
            value = value[name]
        with pytest.raises(InputError, match=f"the setting {old} is now called {new}$"):
            load_settings(kind, "any", None, [f"{old}={value}"], {})
