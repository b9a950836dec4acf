"""`rbpf run` on ROS bags: the same bytes as from the same images in a folder, and one sentence where that cannot be."""

import sys

import pytest

from rbpf.sensors.readers import open_images, open_stereo
from tests.cli import stereo_sequences
from tests.cli.mono_sequences import FRAMES, run, sentence, summary
from tests.cli.run_outputs import outputs
from tests.readers.images.bags import KINDS, film_images, film_pairs, recorded

pytestmark = pytest.mark.slow

IMAGE = "/cam0/image_raw"


@pytest.fixture(scope="module")
def as_bag(desk, tmp_path_factory):
    """The desk's images in a bag of each kind, with their truth."""

    def written(kind, spoil=lambda k, shot: shot):
        path = tmp_path_factory.mktemp("bag") / kind
        with recorded(path) as bag:
            film_images(bag, open_images(desk), spoil)
        # So that both recordings have one name, which several files repeat.
        return path.rename(path.with_name("desk.bag" if path.is_file() else "desk"))

    return written


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_gives_the_bytes_of_its_images_in_a_folder(desk, as_bag, tmp_path, kind):
    known = ["--known-points", str(desk / "known_points.csv")]
    assert run(desk, tmp_path / "folder", "--video") == 0
    assert run(as_bag(kind), tmp_path / "bag", *known, "--truth-topic", "/truth", "--video") == 0
    plain, bag = outputs(tmp_path / "folder"), outputs(tmp_path / "bag")
    assert {name for name in plain | bag if plain.get(name) != bag.get(name)} == {"config.yaml"}


@pytest.mark.parametrize("kind", KINDS[:2])
def test_a_stereo_bag_gives_the_bytes_of_its_folder(room, tmp_path, kind):
    with recorded(tmp_path / kind) as bag:
        film_pairs(bag, open_stereo(room), "image_rect")
    quick = ["--no-video", "--no-batch"]
    assert stereo_sequences.run(room, tmp_path / "folder", *quick) == 0
    assert stereo_sequences.run(tmp_path / kind, tmp_path / "bag", *quick) == 0
    for name in ("trajectory.tum", "map.csv"):
        assert (tmp_path / "folder" / name).read_bytes() == (tmp_path / "bag" / name).read_bytes()


def refused(capsys, path, out, *arguments):
    assert run(path, out, *arguments) == 2
    assert not (out / "summary.json").exists()
    return sentence(capsys)


@pytest.mark.parametrize("kind", KINDS)
def test_a_bag_that_was_cut_off_is_refused(as_bag, tmp_path, capsys, kind):
    path = as_bag(kind)
    file = path if path.is_file() else next(f for f in path.iterdir() if f.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    said = refused(capsys, path, tmp_path / "run")
    assert path.name in said and ("reindex" in said or "none of" in said)


def test_a_topic_that_is_not_there_is_refused(as_bag, tmp_path, capsys):
    said = refused(capsys, as_bag(KINDS[0]), tmp_path / "run", "--image-topic", "/nothing")
    assert f"/nothing is no topic of images; the bag's image topics are {IMAGE}" in said


def test_two_topics_are_not_one_camera(as_bag, tmp_path, capsys):
    said = refused(capsys, as_bag(KINDS[0]), tmp_path / "run", "--image-topic", "/left,/right")
    assert "one camera has one topic of images" in said


def test_times_that_run_backwards_are_refused(as_bag, tmp_path, capsys):
    path = as_bag(KINDS[0], lambda k, shot: shot | ({"stamp": 1, "received": shot["stamp"]} if k == 5 else {}))
    assert "the stamp of image" in refused(capsys, path, tmp_path / "run")


def test_one_bad_image_is_noted_and_survived(as_bag, tmp_path):
    path = as_bag(KINDS[1], lambda k, shot: shot | ({"encoding": "32FC1"} if k == 8 else {}))
    assert run(path, tmp_path / "run") == 0
    entries = summary(tmp_path / "run")
    assert entries["frames_tracked"] == FRAMES
    assert any("frame 8" in note and "32FC1" in note for note in entries["problems"])


def test_without_the_library_a_sentence_says_how_to_get_it(as_bag, tmp_path, capsys, monkeypatch):
    path = as_bag(KINDS[0])
    monkeypatch.setitem(sys.modules, "rosbags", None)
    assert "pip install 'rbpf[bags]'" in refused(capsys, path, tmp_path / "run")
