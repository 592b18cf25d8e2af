"""Waiting OpenMP threads of torch soon sleep unless the user sets another policy."""

import os
import re
import subprocess
import sys

import pytest

WORKERS = """
import os
from vd4rl_pomdp.runs.workers import run_jobs
print(*run_jobs(os.getenv, ["OMP_WAIT_POLICY", "GOMP_SPINCOUNT"], 2))
"""


def run(code: str, **environment: str) -> subprocess.CompletedProcess:
    unset = {name: value for name, value in os.environ.items() if not re.match("OMP_WAIT_POLICY|GOMP_|KMP_", name)}
    command = [sys.executable, "-c", code]
    return subprocess.run(command, env=unset | environment, capture_output=True, text=True, check=True)


def spins(code: str, **environment: str) -> set[str]:
    """Spin counts of waiting threads in every OpenMP library that the code loads."""
    found = set(re.findall("GOMP_SPINCOUNT = '(.*)'", run(code, OMP_DISPLAY_ENV="VERBOSE", **environment).stderr))
    if not found:
        pytest.skip("torch uses another OpenMP library")
    return found


@pytest.mark.parametrize(
    "module", [*("vd4rl_pomdp", "pretrain", "finetune", "baselines"), *("vd4rl_pomdp.cli", "vd4rl_pomdp.__main__")]
)
def test_waiting_threads_soon_sleep_for_any_first_import(module):
    assert spins(f"import {module}; import torch") == {"500"}


def test_workers_inherit_the_wait_policy():
    assert run(WORKERS).stdout.split() == ["PASSIVE", "500"]


@pytest.mark.parametrize(
    ("chosen", "count"),
    [
        ({"OMP_WAIT_POLICY": "ACTIVE"}, "30000000000"),
        ({"OMP_WAIT_POLICY": "PASSIVE"}, "0"),
        ({"GOMP_SPINCOUNT": "5000"}, "5000"),
    ],
)
def test_user_settings_of_openmp_are_kept(chosen, count):
    assert spins("import vd4rl_pomdp; import torch", **chosen) == {count}
