"""Settings that are given go over the system's own defaults, not over those of a group's class."""

from dataclasses import asdict, fields, is_dataclass, replace

import pytest

from rbpf.errors import InputError
from rbpf.ranges import former_names
from rbpf.systems.filtering import LikelihoodConfig, ProposalConfig
from rbpf.systems.mono.config import MonoConfig
from rbpf.systems.range_bearing.config import RangeBearingConfig
from rbpf.systems.settings import load_settings
from rbpf.systems.stereo.config import StereoConfig


def test_the_rest_of_a_group_keeps_the_systems_defaults():
    found = load_settings(StereoConfig, "stereo", None, ["likelihood.truncation=9", "sift.length=128"], {})
    assert found.likelihood.kind == "truncated" != LikelihoodConfig().kind
    assert found.likelihood.truncation == 9.0
    assert found.likelihood.outlier_volume == StereoConfig().likelihood.outlier_volume
    assert found.sift.length == 128 and found.sift.working_scale == 0.5
    found = load_settings(MonoConfig, "mono", None, ["proposal.weights=linearised"], {})
    assert found.proposal.iterations == MonoConfig().proposal.iterations != ProposalConfig().iterations


def test_nothing_given_is_the_default():
    for kind in (MonoConfig, StereoConfig):
        assert asdict(load_settings(kind, "any", None, [], {})) == asdict(kind())


def test_a_joint_map_of_two_cameras_brings_its_own_defaults_and_what_is_set_wins():
    joint = load_settings(StereoConfig, "stereo", None, ["map.kind=joint"], {"particles": 20})
    assert joint == replace(StereoConfig.joint(), particles=20) and joint.likelihood.build().normalised
    assert not load_settings(StereoConfig, "stereo", None, ["map.window=3"], {}).likelihood.build().normalised


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
