"""Names that FFmpeg would take for URLs or for options are files."""

import numpy as np
import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers.images.video import opened
from rbpf.validation.report.video import write_video

PICTURES = np.random.default_rng(0).integers(0, 256, (4, 64, 64, 3), dtype=np.uint8)
STAMPS = 100_000_000 * np.arange(4)


@pytest.mark.parametrize("name", ["12:30.mp4", "-x.mp4", "http:x.mp4", "file:base.mp4", "walk%03d.mp4"])
def test_such_a_video_is_written_and_read(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    path = type(tmp_path)(name)
    write_video(iter(PICTURES), STAMPS, path)
    assert [place.name for place in tmp_path.iterdir()] == [name]
    with opened(path) as capture:
        found, image = capture.read()
    assert found and image.shape == (64, 64, 3)


def test_another_protocol_is_not_followed(tmp_path):
    """A playlist that names another file."""
    write_video(iter(PICTURES), STAMPS, tmp_path / "base.mp4")
    (tmp_path / "list.mp4").write_text("#EXTM3U\n#EXTINF:1,\nhttp://127.0.0.1:9/base.ts\n#EXT-X-ENDLIST\n")
    with pytest.raises(InputError), opened(tmp_path / "list.mp4"):
        pass


def test_a_name_that_is_no_text_is_refused(tmp_path):
    with pytest.raises(InputError, match="must be text in UTF-8"), opened(tmp_path / "walk\udcff.mp4"):
        pass
