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
    "two cameras, room": {_README: r"two cameras \(`stereo_zed_room1`\).*in every particle ",
                          _MEASURED: r"stereo_zed_room1, 105 pairs, 1.9 m \|[^|]*\| "},
    "two cameras, road": {
        _README: r"60 m\).*in every particle ", _MEASURED: r"stereo_kitti_seq1, 51 pairs, 60 m \|[^|]*\| ",
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


# Every equation that the code cites is there, and every numbered equation is cited.

PAGE = (ROOT / "docs" / "mathematics.md").read_text(encoding="utf-8")
LABELS = re.findall(r"^ *\$\$ \(([\w-]+)\)$", PAGE, re.MULTILINE)
FOLDERS = ("rbpf", "sensors", "motion", "maps", "validation", "examples", "benchmarks")
SOURCES = [path for folder in FOLDERS for path in sorted((ROOT / folder).rglob("*.py"))]
EQUATION = re.compile(r"(E06|S05) \((\d+)\)(?:[–-]\((\d+)\))?")


def cited_equations(text: str) -> set[tuple[str, int]]:
    """Paper and number of each equation that a text cites."""
    return {
        (paper, number)
        for paper, first, last in EQUATION.findall(text)
        for number in range(int(first), int(last or first) + 1)
    }


def listed_equations() -> set[tuple[str, int]]:
    """Those of the tables at the end of the page."""
    found, paper = set(), ""
    for line in PAGE.split("## Where the papers' equations are")[1].splitlines():
        if head := re.match(r"\| (E06|S05) \|", line):
            paper = head[1]
        elif row := re.match(r"\| \((\d+)\)(?:–\((\d+)\))? \|", line):
            found |= {(paper, number) for number in range(int(row[1]), int(row[2] or row[1]) + 1)}
    return found


def cited_labels() -> set[str]:
    text = "\n".join(path.read_text(encoding="utf-8") for path in SOURCES)
    return set(re.findall(r"Mathematics\s+\(([\w-]+)\)", text))


def test_numbered_equations_have_one_name_each_and_the_code_cites_all_of_them_and_no_other():
    assert len(LABELS) == len(set(LABELS)) > 20
    unnumbered = re.findall(r"^ *\$\$ *$", PAGE, re.MULTILINE)
    assert len(unnumbered) == len(LABELS), "an equation has no name"
    assert cited_labels() == set(LABELS)


def test_the_equations_of_the_papers_that_code_and_page_cite_are_listed():
    cited = {path.name: cited_equations(path.read_text(encoding="utf-8")) for path in SOURCES}
    assert {name: found - listed_equations() for name, found in cited.items() if found - listed_equations()} == {}
    assert cited_equations(PAGE) <= listed_equations()
    assert listed_equations() == {("E06", n) for n in range(1, 19)} | {("S05", n) for n in range(1, 17)}
