"""Logs with arbitrary bytes in them."""

from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from rbpf.errors import InputError
from rbpf.sensors.readers import RobotLog, open_log


def pieces(*separators: bytes) -> st.SearchStrategy[bytes]:
    """What is put into a file: few bytes, odd numbers, and what separates the format's fields."""
    odd = [b"nan", b"-", b"1e400", b"1e-320", b"1e12", b"9" * 30, b"\n", b"0", b"-1"]
    return st.one_of(st.binary(max_size=6), st.sampled_from([*odd, *separators]))


def mutated(data: Any, files: dict[str, str], put: st.SearchStrategy[bytes]) -> dict[str, bytes]:
    """The files, with a stretch of one of them replaced; `data` is of Hypothesis' strategy of that name."""
    found = {name: text.encode() for name, text in files.items()}
    name = data.draw(st.sampled_from(sorted(found)))
    start = data.draw(st.integers(0, len(found[name])))
    stop = data.draw(st.integers(start, min(start + 12, len(found[name]))))
    return found | {name: found[name][:start] + data.draw(put) + found[name][stop:]}


def write(folder: Path, files: dict[str, Any]) -> Path:
    """Files of text or bytes, by name."""
    for name, text in files.items():
        (folder / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return folder


def is_log_or_one_sentence(path: Path) -> bool:
    """Whether opening ends as it may."""
    try:
        return isinstance(open_log(path), RobotLog)
    except InputError as error:
        return "\n" not in str(error)
