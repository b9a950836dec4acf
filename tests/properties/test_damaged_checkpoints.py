"""Every array of a checkpoint of every system, damaged, with a digest that is right: a sentence, or a run that goes on."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from tests.properties.damaged_checkpoints import CASES

ROOT = Path(__file__).resolve().parents[2]
DAMAGES = 15


@pytest.mark.slow
def test_a_damaged_checkpoint_is_refused_or_gone_on_from(tmp_path):
    command = [sys.executable, "-m", "tests.properties.damaged_checkpoints", str(tmp_path), str(DAMAGES)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, (told[-1:], done.stderr[-2000:])
    for name in CASES:
        whole, *results = [each for each in told if each["case"] == name and "result" in each]
        assert whole == {"case": name, "damage": "none", "result": "went on"}
        assert len(results) == DAMAGES
        assert [each for each in results if each["result"] not in ("refused", "went on")] == []
        assert DAMAGES / 4 < sum(each["result"] == "refused" for each in results) < DAMAGES
