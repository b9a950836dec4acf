"""`rbpf run` on ROS bags: the same bytes as from the same images in a folder, and one sentence where that cannot be."""

import sys

import pytest

from rbpf.sensors.readers import open_images, open_stereo
from tests.cli.run_outputs import outputs
from tests.cli.sequences import refused, run, run_stereo
from tests.readers.images.bags import KINDS, film_images, film_pairs, recorded

pytestmark = pytest.mark.slow


@pytest.fixture
def as_bag(desk, tmp_path):
    """The desk's images in a bag of a kind, with their truth."""

    def written(kind):
        with recorded(tmp_path / kind) as bag:
            film_images(bag, open_images(desk))
        # So that both recordings have one name, which several files repeat.
        return (tmp_path / kind).rename(tmp_path / ("desk.bag" if (tmp_path / kind).is_file() else "desk"))

    return written


def test_a_bag_gives_the_bytes_of_its_images_in_a_folder(desk, as_bag, tmp_path):
    known = ["--known-points", str(desk / "known_points.csv")]
    assert run(desk, tmp_path / "from_folder", "--video") == 0
    from_folder = outputs(tmp_path / "from_folder")
    assert run(as_bag(KINDS[1]), tmp_path / "run", *known, "--truth-topic", "/truth", "--video") == 0
    bag = outputs(tmp_path / "run")
    assert {name for name in from_folder | bag if from_folder.get(name) != bag.get(name)} == {"config.yaml"}


def test_a_stereo_bag_gives_the_bytes_of_its_folder(room, tmp_path):
    with recorded(tmp_path / KINDS[0]) as bag:
        film_pairs(bag, open_stereo(room), "image_rect")
    quick = ["--no-video", "--no-batch"]
    assert run_stereo(room, tmp_path / "folder", *quick) == 0
    assert run_stereo(tmp_path / KINDS[0], tmp_path / "bag", *quick) == 0
    for name in ("trajectory.tum", "map.csv"):
        assert (tmp_path / "folder" / name).read_bytes() == (tmp_path / "bag" / name).read_bytes()


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_that_was_cut_off_is_refused(as_bag, tmp_path, capsys, kind):
    path = as_bag(kind)
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    said = refused(capsys, path, tmp_path / "run")
    assert path.name in said and ("reindex" in said or "none of" in said)


def test_two_topics_are_not_one_camera(as_bag, tmp_path, capsys):
    said = refused(capsys, as_bag(KINDS[0]), tmp_path / "run", "--image-topic", "/left,/right")
    assert "one camera has one topic of images" in said


def test_without_the_library_a_sentence_says_how_to_get_it(as_bag, tmp_path, capsys, monkeypatch):
    path = as_bag(KINDS[0])
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert "pip install 'rbpf[bags]'" in refused(capsys, path, tmp_path / "run")
