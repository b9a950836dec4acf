"""Bad images, calibrations and tables: one clear sentence where the run stops, a note where it goes on."""

import re

import cv2
import numpy as np
import pytest

from tests.cli.mono_sequences import FRAMES, refused, run, summary

pytestmark = pytest.mark.slow


def survived(folder, out, *arguments):
    """The summary of a run that went on to the last frame."""
    assert run(folder, out, *arguments) == 0
    entries = summary(out)
    assert entries["frames"] == FRAMES
    return entries


def image_path(folder, number):
    return folder / "images" / f"{number:06d}.png"


def test_darkness_from_the_start_is_said_and_no_frame_of_it_counts_as_tracked(folder, tmp_path):
    for number in range(FRAMES):
        if number < 9:
            path = image_path(folder, number)
            cv2.imwrite(str(path), np.zeros_like(cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)))
    entries = survived(folder, tmp_path / "run")
    assert "shows nothing" in entries["problems"][0]
    assert 4 <= entries["frames_tracked"] <= FRAMES - 7
    assert entries["observations_per_frame"] > 2.0


def mixed_up(rows):
    return [[*row[:3], *rows[k - 1][3:]] for k, row in enumerate(rows)]


def in_line(rows):
    return [[*row[:3], str(0.1 * k), str(0.2 * k), "0.0", row[6]] for k, row in enumerate(rows)]


def grey_about_the_second(rows, folder):
    """What is spoilt is the image."""
    image = cv2.imread(str(image_path(folder, 0)), cv2.IMREAD_GRAYSCALE)
    u, v = round(float(rows[1][1])), round(float(rows[1][2]))
    image[v - 12 : v + 13, u - 12 : u + 13] = 128
    cv2.imwrite(str(image_path(folder, 0)), image)


@pytest.mark.parametrize(
    ("edit", "words"),
    [(mixed_up, "which point is which"), (in_line, "lie on a line"), (None, "known point 2 .* shows no corner there")],
)
def test_known_points_that_cannot_be_are_refused(desk, folder, tmp_path, capsys, edit, words):
    header, *lines = (desk / "known_points.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines]
    if edit is None:
        grey_about_the_second(rows, folder)
    else:
        rows = edit(rows)
    points = tmp_path / "points.csv"
    points.write_text("\n".join([header, *map(",".join, rows)]) + "\n")
    assert re.search(words, refused(capsys, folder, tmp_path / "run", "--known-points", points))


def test_results_cannot_replace_a_file(folder, tmp_path, capsys):
    (tmp_path / "taken").write_text("mine")
    assert "is a file" in refused(capsys, folder, tmp_path / "taken")
    assert (tmp_path / "taken").read_text() == "mine"
