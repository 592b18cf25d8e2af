"""A part of the bad inputs of `tools/bad_input.py`, evenly spread over its list, each as the script tries it."""

import subprocess
import sys
from pathlib import Path

SCRIPT = Path(__file__).parents[2] / "tools" / "bad_input.py"


def test_bad_input_ends_in_one_line_and_exit_code_2():
    done = subprocess.run([sys.executable, SCRIPT, "--every", "67"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr
    tried = int(done.stdout.splitlines()[-1].split()[0])
    assert tried > 40
