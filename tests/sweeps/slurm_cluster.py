"""A temporary one-node Slurm cluster on this machine, from Debian's packages."""

import os
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from pathlib import Path

from tests.helpers_sweeps import until

CPUS = 8
CONFIGURATION = """
ClusterName=test
SlurmctldHost={host}(127.0.0.1)
SlurmctldPort={ports[0]}
SlurmdPort={ports[1]}
SlurmUser=root
AuthType=auth/munge
AuthInfo=socket={folder}/munge.socket,cred_expire=5
CredType=cred/munge
StateSaveLocation={folder}/state
SlurmdSpoolDir={folder}/spool
SlurmctldPidFile={folder}/slurmctld.pid
SlurmdPidFile={folder}/slurmd.pid
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_Core
SchedulerType=sched/builtin
SchedulerParameters=batch_sched_delay=0,sched_interval=1,sched_min_interval=0
AccountingStorageType=accounting_storage/none
JobAcctGatherType=jobacct_gather/none
MpiDefault=none
SwitchType=switch/none
SlurmdParameters=config_overrides
NodeName={host} NodeAddr=127.0.0.1 CPUs={cpus} RealMemory=1000 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES MaxTime=60 State=UP
"""


def why_not() -> str:
    """Why no cluster can be started here; empty if one can."""
    if find_spec("submitit") is None:
        return "no submitit: pip install '.[slurm]'"
    missing = [name for name in ("munged", "slurmctld", "slurmd", "sbatch") if shutil.which(name) is None]
    if missing:
        return f"no {missing[0]}: apt-get install --no-install-recommends slurmctld slurmd slurm-client munge"
    return "" if os.geteuid() == 0 else "slurmd and munged are started as root here"


@contextmanager
def slurm(folder: Path) -> Iterator[Path]:
    """Start a cluster and yield its slurm.conf."""
    key, configuration = folder / "munge.key", folder / "slurm.conf"
    key.write_bytes(os.urandom(128))
    key.chmod(0o400)
    for name in ("state", "spool"):
        (folder / name).mkdir()
    settings = {"host": socket.gethostname(), "ports": _free_ports(2), "folder": folder, "cpus": CPUS}
    configuration.write_text(CONFIGURATION.format(**settings))
    paths = {name: folder / f"munge.{name}" for name in ("socket", "pid", "seed", "log")}
    munged = ["munged", "--foreground", "--force", f"--key-file={key}"]
    munged += [f"--{name}{'' if name == 'socket' else '-file'}={path}" for name, path in paths.items()]
    started: list[subprocess.Popen] = []
    environment = os.environ | {"SLURM_CONF": str(configuration)}
    try:
        for words in (munged, ["slurmctld", "-D"], ["slurmd", "-D", "-N", settings["host"]]):
            with (folder / f"{words[0]}.out").open("wb") as out:
                started.append(subprocess.Popen(words, env=environment, stdout=out, stderr=out))
            until(paths["socket"].exists)
        until(lambda: _state(environment) == "idle")
        yield configuration
    finally:
        subprocess.run(["scancel", "--me"], env=environment, check=False)
        until(lambda: not _output_of(["squeue", "--noheader"], environment))
        for process in reversed(started):
            process.terminate()
            process.wait(30)


def _state(environment: dict[str, str]) -> str:
    return _output_of(["sinfo", "--noheader", "--format=%T"], environment)


def _output_of(words: list[str], environment: dict[str, str]) -> str:
    return subprocess.run(words, env=environment, capture_output=True, text=True, check=False).stdout.strip()


def _free_ports(number: int) -> list[int]:
    sockets = [socket.socket() for _ in range(number)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports
