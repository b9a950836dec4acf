"""A report shows what lies in the run's folder, and nothing else of the disk."""

from rbpf.validation.report.page import _images


def test_a_link_that_points_outside_is_not_embedded(tmp_path):
    (tmp_path / "secret").write_bytes(b"secret")
    run = tmp_path / "run"
    run.mkdir()
    (run / "own.png").write_bytes(b"own")
    (run / "evil.png").symlink_to(tmp_path / "secret")
    (run / "again.png").symlink_to("own.png")
    assert [name for name, _ in _images(run, ["own.png", "evil.png", "again.png"])] == ["own", "again"]
