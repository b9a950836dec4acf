"""A file that holds nothing but a byte-order mark is empty."""

from codecs import BOM_UTF8

import pytest

from rbpf.errors import InputError
from rbpf.sensors.readers.text import read_columns, read_csv, read_lines, read_stamped


@pytest.mark.parametrize("content", [BOM_UTF8, BOM_UTF8 + b"\n", b" \n"])
@pytest.mark.parametrize(
    "read",
    [
        read_lines,
        lambda path: read_csv(path, [("a", "b")]),
        lambda path: read_columns(path, ("a", "b")),
        lambda path: read_stamped(path, "times"),
    ],
)
def test_it_is_said(tmp_path, read, content):
    path = tmp_path / "table.csv"
    path.write_bytes(content)
    with pytest.raises(InputError, match="the file is empty"):
        read(path)
