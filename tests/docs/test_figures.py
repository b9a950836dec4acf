"""What is told of one thing on several pages is the same figure, rounded as each page rounds."""

import re

import pytest

from tests.docs.blocks import ROOT

_README, _MEASURED, _STEREO = "README.md", "docs/measured.md", "docs/how_to/stereo.md"
_NUMBER = r"([\d.]+(?: mm)?)"
#: By a name what stands before the figure on each page that tells it; the first figure behind it counts.
TWICE = {
    "robot in the plane": {_README: r"`mrpt_kf_slam_2d`\) \| ", _MEASURED: r"\n\| mrpt_kf_slam_2d \| (?=0.0043 \(0.0000)"},
    "its batch optimum": {_README: r"`mrpt_kf_slam_2d`\) \| [^|]*\| ", _MEASURED: r"\n\| mrpt_kf_slam_2d \| 0.681 \|[^|]*\| "},
    "its odometry": {_README: r"`mrpt_kf_slam_2d`.*odometry ", _MEASURED: r"\n\| mrpt_kf_slam_2d \| (?=0.681)"},
    "robot in space": {_README: r"`mrpt_kf_slam_6d`\) \| ", _MEASURED: r"\n\| mrpt_kf_slam_6d \| (?=0.0121)"},
    "its batch optimum, in space": {
        _README: r"`mrpt_kf_slam_6d`\) \| [^|]*\| ", _MEASURED: r"\n\| mrpt_kf_slam_6d \| 1.156 \|[^|]*\| "
    },
    "real robot": {_README: r"`mrclam6_robot1`\) \| ", _MEASURED: r"mrclam6_robot1, likelihood with outliers \| "},
    "its odometry, real": {_README: r"`mrclam6_robot1`.*odometry ", _MEASURED: r"\n\| mrclam6_robot1 \| (?=2.06)"},
    "one camera, room": {_README: r"`stereo_zed_room1`, left\) \| ",
                         _MEASURED: r"stereo_zed_room1, left camera, 105 frames \| "},
    "one camera, kitchen": {_README: r"`mono_redkitchen_a`\) \| ", _MEASURED: r"mono_redkitchen_a, 500 frames[^|]*\| "},
    "with alignment": {_README: r"`mono_redkitchen_a`\) \| [\d.]+ m, Sim\(3\) ",
                       _MEASURED: r"mono_redkitchen_a, 500 frames[^|]*\|[^|]*\| "},
    "without known points": {_README: r"the same without known points \| Sim\(3\) ",
                             _MEASURED: r"mono_redkitchen_a without known points \| \| "},
    "two cameras, room": {_README: r"two cameras \(`stereo_zed_room1`\) \| ",
                          _MEASURED: r"stereo_zed_room1, 105 pairs, 1.9 m \|[^|]*\| "},
    "two cameras, road": {
        _README: r"`stereo_kitti_seq1`, 60 m\) \| ", _MEASURED: r"stereo_kitti_seq1, 51 pairs, 60 m \|[^|]*\| ",
        _STEREO: r"`stereo_kitti_seq1`, 51 pairs, 60 m \| ",
    },
    "its odometry, road": {
        _README: r"`stereo_kitti_seq1`, 60 m\).*odometry ", _MEASURED: r"stereo_kitti_seq1, 51 pairs, 60 m \| ",
        _STEREO: r"`stereo_kitti_seq1`, 51 pairs, 60 m \|[^|]*\|[^|]*\| ",
    },
    "laser scanner": {_README: r"`laser_intel`\), relations of poses \| ", _MEASURED: r"at the end \(`posterior.tum`\) \| "},
    "GMapping": {_README: r"relations of poses.*GMapping ", _MEASURED: r"GMapping, as published \| "},
}  # fmt: skip


@pytest.mark.parametrize("name", TWICE)
def test_a_figure_that_stands_twice_is_one_figure(name):
    told = []
    for page, before in TWICE[name].items():
        found = re.search(f"(?:{before}){_NUMBER}", (ROOT / page).read_text(encoding="utf-8"))
        assert found is not None, f"{page} no longer tells it as /{before}/"
        number, _, unit = found[1].partition(" ")
        decimals = len(number.partition(".")[2]) + (3 if unit == "mm" else 0)
        told.append((float(number) * (1e-3 if unit == "mm" else 1.0), decimals, page))
    coarse = min(decimals for _, decimals, _ in told)
    values = {page: round(value, coarse) for value, _, page in told}
    assert max(values.values()) - min(values.values()) < 0.5 * 10.0**-coarse, values
