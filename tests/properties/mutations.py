"""Bytes of a file, damaged at random: by chance, and by what breaks careless readers."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from hypothesis import strategies as st

from rbpf.errors import InputError

TOKENS = [
    b"nan", b"-inf", b"1e999", b"-1", b"0", b"99999999999999999999", b"1000000000000", b"0x1p3", b"1_0", b"\xff\xfe",
    b"\x00", b"\n", b"\r", b",", b" ", b"#", b"''", b"\xe2\x88\x9e", b"[" * 3000, b"{", b"}", b"...", b"---",
    b"&a [*a]", b"!!python/object/apply:os.system ['touch pwned']", b"!!timestamp x", b"!!int x", b"!!bool maybe",
    b"!!float ''", b"!!binary =", b"2001-99-99", b": :", b"null", b"true", b"1" * 5000, b"../../../etc/passwd",
    b"%s%n", b"<<: x",
]  # fmt: skip


@st.composite
def damaged(draw: st.DrawFn, whole: bytes) -> bytes:
    """One to three edits: a token put in or over something, a piece cut out or doubled, a bit flipped, the end cut."""
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 3))):
        start = draw(st.integers(0, len(data)))
        stop = min(len(data), start + draw(st.integers(0, 40)))
        kind = draw(st.sampled_from(["token", "over", "cut", "double", "flip", "end"]))
        if kind == "token":
            data[start:start] = draw(st.sampled_from(TOKENS))
        elif kind == "over":
            data[start:stop] = draw(st.sampled_from(TOKENS))
        elif kind == "cut":
            del data[start:stop]
        elif kind == "double":
            data[start:start] = data[start:stop]
        elif kind == "flip" and start < len(data):
            data[start] ^= 1 << draw(st.integers(0, 7))
        else:
            del data[start:]
    return bytes(data)


def read_or_refused(read: Callable[[], object]) -> None:
    """Anything but success and one sentence fails."""
    try:
        read()
    except InputError as error:
        said = str(error)
    else:
        return
    assert said.strip() and "\n" not in said


@contextmanager
def restored(path: Path) -> Iterator[bytes]:
    """What a file holds, which is put back afterwards."""
    whole = path.read_bytes()
    try:
        yield whole
    finally:
        path.write_bytes(whole)
