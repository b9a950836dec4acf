"""Digests of the results of short runs of every system, which a refactoring must not change.

    python benchmarks/digests.py record FILE       runs the cases and writes their digests
    python benchmarks/digests.py compare FILE      runs them again and says what differs

Runs use the command line, so that only results visible to users are compared. The last digits depend on the processor
and on library versions: record and compare on one machine, in one environment. Arrays are compared by name and
content; those of a checkpoint, which may be renamed, only by content. Times are excluded.
"""

import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

DATA = Path(os.environ.get("RBPF_DATA", "../shared/data")).resolve()
RBPF = [sys.executable, "-m", "rbpf"]
TIMES = ("finished", "ms_per_", "peak_memory", "seconds", "_ms", "milliseconds")


def rbpf(*words: Any) -> None:
    """Runs a command that must succeed."""
    done = subprocess.run([*RBPF, *map(str, words)], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"rbpf {' '.join(map(str, words))}: {done.returncode}\n{done.stderr}")


def interrupted(out: Path, *words: Any) -> None:
    """Runs, stops at the first checkpoint, and resumes."""
    process = subprocess.Popen(
        [*RBPF, *map(str, words), "--out", str(out)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    while process.poll() is None and not (out / "checkpoint.npz").exists():
        time.sleep(0.02)
    process.send_signal(signal.SIGINT)
    process.wait()
    rbpf(*words, "--out", out, "--resume")


def beginning(name: str, frames: int, folder: Path) -> Path:
    """The first images of a TUM-style recording, as a separate recording."""
    source, target = DATA / name, folder / name
    target.mkdir()
    for file in source.iterdir():
        if file.is_file():
            shutil.copy(file, target)
    lines = [line for line in (source / "rgb.txt").read_text().splitlines() if not line.startswith("#")]
    (target / "rgb.txt").write_text("\n".join(lines[:frames]) + "\n")
    (target / "rgb").symlink_to(source / "rgb")
    return target


def cases(work: Path) -> dict[str, tuple[Any, ...]]:
    """The runs by name; a run whose name ends in `resumed` is interrupted once."""
    desk, pairs, plane, space = work / "desk", work / "pairs", work / "plane", work / "space"
    rbpf("simulate", "desk", "--frames", 45, "--width", 320, "--height", 240, "--out", desk)
    rbpf("simulate", "desk", "--frames", 20, "--baseline-m", 0.1, "--width", 320, "--height", 240, "--out", pairs)
    rbpf("simulate", "range-bearing", "--steps", 80, "--out", plane)
    rbpf("simulate", "range-bearing", "--steps", 60, "--spatial", "--out", space)
    kitchen = beginning("mono_redkitchen_a", 60, work)
    mono, stereo, robot = ("run", "mono"), ("run", "stereo", "--no-video"), ("run", "range-bearing")
    known = ("--known-points", desk / "known_points.csv", "--no-video")
    few = ("--particles", 50, "--no-batch")
    rbpf(*mono, desk, *known, "--no-batch", "--out", work / "mapped")
    return {
        "robot_plane": (*robot, plane),
        "robot_space": (*robot, space),
        "robot_unknown": (*robot, plane, "--association", "ml"),
        "robot_resumed": (*robot, plane, "--set", "checkpoint_every=10"),
        "robot_real": (*robot, DATA / "mrpt_kf_slam_6d"),
        "mono_known": (*mono, desk, *known),
        "mono_points": (*mono, desk, *known, "--set", "known=points"),
        "mono_unknown": (*mono, desk, "--no-video", "--no-batch"),
        "mono_resumed": (*mono, desk, *known, "--set", "checkpoint_every=10", "--no-batch"),
        "mono_localised": (*mono, desk, "--map", work / "mapped", "--localize", "--no-video", "--no-batch"),
        "mono_real": (*mono, kitchen, "--known-points", kitchen / "known_points.csv", "--no-video"),
        "stereo_rendered": (*stereo, pairs),
        "stereo_resumed": (*stereo, pairs, *few, "--set", "checkpoint_every=5"),
        "stereo_real": (*stereo, DATA / "stereo_kitti_seq1", "--particles", 100, "--no-batch"),
        "stereo_refined": (
            *stereo, pairs, *few, "--dof", 3, "--set", "proposal.kind=ekf", "--set", "likelihood.kind=outliers"
        ),
    }  # fmt: skip


def digest(content: bytes) -> str:
    """A shortened digest."""
    return hashlib.sha256(content).hexdigest()[:16]


def timeless(value: Any) -> Any:
    """A summary without times and paths of its folder."""
    if isinstance(value, dict):
        return {name: timeless(v) for name, v in value.items() if not any(t in name for t in TIMES)}
    return value


def digests_of(folder: Path) -> dict[str, str]:
    """Digest of every array, table and text in a run's folder."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.suffix == ".npz":
            with np.load(path, allow_pickle=False) as arrays:
                content = {
                    name: digest(str(arrays[name].shape).encode() + np.ascontiguousarray(arrays[name]).tobytes())
                    for name in arrays.files
                    if name != "header" and not any(word in name for word in TIMES)
                }
            if path.name == "checkpoint.npz":
                found[path.name] = " ".join(sorted(set(content.values())))
            else:
                found |= {f"{path.name}:{name}": value for name, value in content.items()}
        elif path.name in ("summary.json", "validation_groundtruth.json"):
            entries = timeless(json.loads(path.read_text()))
            found |= {f"{path.name}:{name}": digest(json.dumps(v).encode()) for name, v in entries.items()}
        elif path.suffix in (".tum", ".csv") and path.name != "timings.csv":
            found[path.name] = digest(path.read_bytes())
    return found


def all_digests(only: list[str]) -> dict[str, dict[str, str]]:
    """Digests of all cases, run two at a time."""
    with tempfile.TemporaryDirectory() as name, ThreadPoolExecutor(2) as pool:
        work = Path(name)
        chosen = {case: words for case, words in cases(work).items() if not only or case in only}

        def one(case: str) -> dict[str, str]:
            started, out = time.monotonic(), work / case
            if case.endswith("resumed"):
                interrupted(out, *chosen[case])
            else:
                rbpf(*chosen[case], "--out", out)
            found = digests_of(out)
            print(f"{case}: {len(found)} digests, {time.monotonic() - started:.0f} s", file=sys.stderr)
            return found

        return dict(zip(chosen, pool.map(one, chosen), strict=True))


def main() -> None:
    """See above."""
    verb, path, *only = sys.argv[1:]
    found = all_digests(only)
    if verb == "record":
        Path(path).write_text(json.dumps(found, indent=1) + "\n")
        return
    recorded, differing = json.loads(Path(path).read_text()), 0
    for case, now in found.items():
        before = recorded[case]
        for name in sorted(before.keys() | now.keys()):
            if before.get(name) != now.get(name):
                differing += 1
                gone = "missing now" if name not in now else "new" if name not in before else "differs"
                print(f"{case}: {name} {gone}")
                if name == "checkpoint.npz" and name in now and name in before:
                    was, is_ = set(before[name].split()), set(now[name].split())
                    print(f"    {len(was - is_)} of {len(was)} arrays gone, {len(is_ - was)} new")
    print(f"{differing} differences in {len(found)} cases")
    raise SystemExit(differing > 0)


if __name__ == "__main__":
    main()
