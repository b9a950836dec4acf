"""Every equation that the code cites is there, and every numbered equation is cited."""

import re

from tests.docs.blocks import ROOT

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


def test_numbered_equations_have_one_name_each():
    assert len(LABELS) == len(set(LABELS)) > 20
    unnumbered = re.findall(r"^ *\$\$ *$", PAGE, re.MULTILINE)
    assert len(unnumbered) == len(LABELS), "an equation has no name"


def test_every_citation_of_this_page_resolves():
    assert cited_labels() <= set(LABELS)


def test_every_numbered_equation_is_cited_by_the_code():
    assert set(LABELS) <= cited_labels()


def test_every_equation_of_a_paper_that_the_code_cites_is_listed():
    cited = {path.name: cited_equations(path.read_text(encoding="utf-8")) for path in SOURCES}
    assert {name: found - listed_equations() for name, found in cited.items() if found - listed_equations()} == {}


def test_the_page_cites_no_equation_that_it_does_not_list():
    assert cited_equations(PAGE) <= listed_equations()
    assert listed_equations() == {("E06", n) for n in range(1, 19)} | {("S05", n) for n in range(1, 17)}
